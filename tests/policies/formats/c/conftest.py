"""A small policy exported as C, once for all tests; without a C compiler they are left out."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from policies.formats.c.compiler import find_compiler
from policies.formats.c.project import c_project, random_observations
from policies.formats.policy_file import load_policy_checkpoint, save_policy
from tests.policies.conftest import SPEC, lively
from tracks.geometry.camera import Camera

ODD = replace(
    SPEC,
    camera=Camera(width=36, height=20),
    hidden_size=50,
    channels=(6, 96, 32),
    gate_axis=True,
    second_axis=True,
)
"""Sizes that fill no block and no group of four pixels."""


def pytest_collection_modifyitems(items):
    if find_compiler() is None:
        for item in items:
            if "/formats/c/" in str(item.path):
                item.add_marker(pytest.mark.skip(reason="no C compiler: cc, or what CC names"))


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture(scope="session")
def exports(tmp_path_factory, checkpoint):
    """Folder, project and checkpoint by name: float32, int8, and both of odd sizes."""
    odd = save_policy(tmp_path_factory.mktemp("odd") / "odd", lively(ODD, 4), ODD, seed=1)
    made = {}
    for name, source, dtype in (
        ("float32", checkpoint, "float32"),
        ("int8", checkpoint, "int8"),
        ("odd", odd, "float32"),
        ("odd8", odd, "int8"),
    ):
        stored = load_policy_checkpoint(source)
        project = c_project(
            stored, source.name, dtype, random_observations(stored.spec, 40, seed=5)
        )
        folder = tmp_path_factory.mktemp(name)
        for file, text in project.files.items():
            (folder / file).write_text(text)
        made[name] = SimpleNamespace(folder=folder, checkpoint=stored, project=project)
    return made
