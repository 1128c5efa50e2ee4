"""Tables of names: lazy, in order, and nothing twice."""

import sys
from importlib.metadata import EntryPoint

import pytest

from tracks.common import names as registry
from tracks.common.names import Registry


class Package:
    """Where an entry point says that it comes from."""

    def __init__(self, name):
        self.name = name


def installed(monkeypatch, **values):
    """Let packages have entry points: name -> (package, value)."""
    found = []
    for name, (package, value) in values.items():
        entry = EntryPoint(name, value, "things")
        vars(entry).update(dist=Package(package))
        found.append(entry)

    class Found(list):
        def select(self, group):
            return [entry for entry in self if entry.group == group]

    monkeypatch.setattr(registry, "_installed", lambda: Found(found))


def table(**own):
    def check(name, value):
        return None if value else "nothing there"

    return Registry("thing", "things", own, check)


def test_ours_come_first_and_in_order_and_added_ones_after(monkeypatch):
    installed(monkeypatch, b=("two", "math:pi"), a=("one", "math:e"))
    found = table(z=1, y="math:tau")
    found.register("x", 5)
    assert list(found) == ["z", "y", "a", "b", "x"] and len(found) == 5
    assert found["y"] == pytest.approx(6.283, abs=1e-3)
    assert found["b"] == pytest.approx(3.1416, abs=1e-4)


def test_one_of_ours_is_found_without_asking_packages_or_importing(monkeypatch):
    monkeypatch.setattr(registry, "_installed", lambda: pytest.fail("asked"))
    sys.modules.pop("wave", None)
    found = table(z=1, late="wave")
    assert found["z"] == 1 and "late" in found and found.find("z") == 1
    assert "wave" not in sys.modules
    assert found["late"].__name__ == "wave"


def test_a_name_is_given_once(monkeypatch):
    installed(monkeypatch, a=("one", "math:e"))
    found = table(z=1)
    for name in ("z", "a"):
        with pytest.raises(ValueError, match=f"thing '{name}' is there already"):
            found.register(name, 2)
    installed(monkeypatch, z=("one", "math:e"))
    with pytest.raises(ValueError, match="'z' of the package 'one'.*the suite too.*rename"):
        list(table(z=1))


def test_unknown_broken_and_wrong_entries_say_what_to_do(monkeypatch):
    installed(monkeypatch, a=("one", "no_such_module:x"), b=("two", "math:e"))
    found = table(zebra=1)
    with pytest.raises(ValueError, match="unknown thing 'zebr'.*'zebra'.*Known: zebra, a, b"):
        found.find("zebr")
    with pytest.raises(KeyError):
        found["zebr"]
    with pytest.raises(ValueError, match="'a' of the package 'one'.*ModuleNotFound.*uninstall"):
        found["a"]
    with pytest.raises(ValueError, match="thing 'nil'.*nothing there"):
        found.register("nil", 0)
