"""Names in the cache follow the code that flies."""

from eval.quadrotor.vehicle_file import load_vehicle
from suite.experiments.study import cache
from suite.experiments.study.cache import code_digest, digest


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
