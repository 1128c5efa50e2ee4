"""The layout of the four packages: short files, small folders, few entries at each root."""

from pathlib import Path

from tests.support.tools import program

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("tracks", "policies", "eval", "suite")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
CATALOGUES = ("eval/effects", "eval/sensors", "suite/commands")
"""Folders that hold one file a thing, however many there are."""
LINES_MOST, FILES_MOST, ENTRIES_MOST = 400, 12, 9


def test_no_file_is_longer_than_allowed():
    files = [*MODULES, *(ROOT / "tests").rglob("*.py"), *(ROOT / "tools").glob("*.py")]
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in files}
    assert not {path: count for path, count in lines.items() if count > LINES_MOST}


def test_a_folder_is_one_idea():
    folders = {path.parent for path in MODULES} - {ROOT / name for name in CATALOGUES}
    counts = {
        folder: sum(path.name != "__init__.py" for path in folder.glob("*.py"))
        for folder in folders
    }
    assert not {folder: count for folder, count in counts.items() if count > FILES_MOST}


def test_a_packages_root_is_seen_at_one_glance():
    catalogues = [Path(name).name for name in CATALOGUES]
    hidden = ("__init__.py", "py.typed", "__pycache__", *catalogues)
    for package in PACKAGES:
        entries = [path.name for path in (ROOT / package).iterdir() if path.name not in hidden]
        assert len(entries) <= ENTRIES_MOST, (package, entries)


def test_every_fault_to_plant_has_its_text_in_the_code_and_its_tests():
    tool = program(ROOT / "tools" / "plant_faults.py")
    folders = [ROOT / name for name in (*PACKAGES, "tests")]
    files = [path for folder in folders for path in folder.rglob("*.*") if path.is_file()]
    names = [path.relative_to(ROOT).as_posix() for path in files]
    for fault in tool.FAULTS:
        assert tool.place_of(fault, names, ROOT).is_file() and tool.tests_of(fault, names)
