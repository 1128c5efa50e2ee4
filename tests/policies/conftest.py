"""A policy with actions of the size that racing has, saved and exported once for all tests."""

import pytest

from policies.formats import onnx_file, torch_file
from policies.formats.export import export_policy
from tests.support.policy_files import SPEC, InProcess, lively, small_checkpoint


@pytest.fixture(scope="session")
def params():
    return lively(SPEC, 2)


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory):
    return small_checkpoint(tmp_path_factory.mktemp("policy"))


@pytest.fixture(scope="session")
def exported(tmp_path_factory, checkpoint):
    """The folder with tiny.pt2 and tiny.onnx."""
    folder = tmp_path_factory.mktemp("exported")
    export_policy(checkpoint, folder)
    return folder


@pytest.fixture
def in_process(monkeypatch):
    """Engines load models in this process, where they are imported already."""
    for where in (torch_file, onnx_file):
        monkeypatch.setattr(where, "ModelProcess", InProcess)
