"""Names in the cache follow the code that flies."""

from importlib.metadata import EntryPoint, EntryPoints

from eval.quadrotor.vehicle_file import load_vehicle
from suite.experiments.study import cache
from suite.experiments.study.cache import added_digest, code_digest, digest
from tracks.common import names as registry


def test_the_cache_is_named_by_all_code_that_flies(tmp_path, monkeypatch):
    for room, name in (("eval", "judge.py"), ("eval", "view/video.py"), ("suite", "cli.py")):
        path = tmp_path / room / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("one")
    monkeypatch.setattr(cache, "ROOT", tmp_path)
    code_digest.cache_clear()

    def now():
        code_digest.cache_clear()
        return code_digest("eval")

    first = now()
    (tmp_path / "suite" / "cli.py").write_text("two")
    (tmp_path / "eval" / "view" / "video.py").write_text("two")
    assert now() == first, "neither flies"
    (tmp_path / "eval" / "judge.py").write_text("two")
    second = now()
    (tmp_path / "eval" / "judge.py").rename(tmp_path / "eval" / "jury.py")
    assert len({first, second, now()}) == 3
    code_digest.cache_clear()
    assert digest({"a": 1}) != digest({"a": 2}) and len(digest(load_vehicle("reference"))) == 16


def test_the_cache_is_named_by_what_other_packages_add(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_installed", lambda: EntryPoints([]))
    assert added_digest() is None
    monkeypatch.syspath_prepend(tmp_path)
    single, package = tmp_path / "extra_drag.py", tmp_path / "extra_tracks" / "spiral.py"
    package.parent.mkdir()
    for path in (single, package, package.with_name("__init__.py")):
        path.write_text("FORCE = 1")
    entries = EntryPoints(
        [
            EntryPoint("drag", "extra_drag:FORCE", "diffracing_suite.effects"),
            EntryPoint("spiral", "extra_tracks.spiral:FORCE", "diffracing_suite.tracks"),
            EntryPoint("gone", "extra_gone:FORCE", "diffracing_suite.tracks"),
            EntryPoint("other", "extra_other:FORCE", "another_program.effects"),
        ]
    )
    monkeypatch.setattr(registry, "_installed", lambda: entries)
    found = [added_digest()]
    for path in (single, package):
        path.write_text("FORCE = 2")
        found.append(added_digest())
    assert None not in found and len(set(found)) == 3
    assert [entry.name for entry in registry.added_entries()] == ["drag", "gone", "spiral"]
