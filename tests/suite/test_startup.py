"""Odd surroundings: no home, no streams, other locales, JAX's variables, a machine in trouble."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from suite import cli
from suite.common import startup
from suite.common.console import Console
from tests.support.commands import refused
from tests.support.tools import python
from tracks.common import files
from tracks.common.grid import markdown, rich_table, table
from tracks.common.names import printable
from tracks.input.reading import InputError, parse_json

ESCAPE = "a\x1b]0;owned\x07\x1b[31mb"


FORKS = """
import json, os, signal, sys
from suite import cli
from suite.common import console, options
for line in sys.stdin:
    args, cwd, env, before, streams = json.loads(line)
    child = os.fork()
    if not child:
        signal.alarm(120)
        os.chdir(cwd)
        os.environ.update(env)
        sys.argv = ["suite", *args]
        for number, file in enumerate(streams):
            os.dup2(os.open(file, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        exec(before)
        cli.entry()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""A program whose forks are each the program `suite` as it starts: quicker than an interpreter."""
CLOSED = (
    "for number in range(3): os.close(number)\n"
    "sys.stdin = sys.stdout = sys.stderr = None\n"  # as Python itself finds them closed
)
UNBUFFERED = "sys.stdout = open(1, 'w', closefd=False)\nsys.stdout.reconfigure(write_through=True)"


class Program:
    """`suite` as a program, in an environment that holds no variables but a few."""

    def __init__(self, root, folder, **env):
        paths = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
        env = {"PATH": os.environ["PATH"], "PYTHONPATH": paths, "LC_ALL": "C", **env}
        self.folder, self.out, self.err = folder, folder / "out.txt", folder / "err.txt"
        self.process = subprocess.Popen(
            [sys.executable, "-c", FORKS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=env,
        )  # fmt: skip

    def __call__(self, line, cwd=None, env=None, before="", out=None, err=None):
        """Run a command line after the statements `before`; return its code and standard error."""
        assert self.process.stdin and self.process.stdout
        streams = [os.devnull, str(out or self.out), str(err or self.err)]
        job = [line.split(), str(cwd or self.folder), env or {}, before, streams]
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        code = int(self.process.stdout.readline())
        return code, "" if err else self.err.read_text()


@pytest.fixture(scope="module")
def suite(root, tmp_path_factory):
    program = Program(root, tmp_path_factory.mktemp("program"))
    yield program
    program.process.communicate()


def test_without_a_home_that_can_be_written_there_is_a_place_of_ones_own(tmp_path, monkeypatch):
    def nobody():
        raise RuntimeError("Could not determine home directory.")

    (tmp_path / "file").touch()
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with monkeypatch.context() as patch:
        patch.setattr(Path, "home", nobody)
        place = files.user_cache()
        assert place == tmp_path / f"diffracing-suite-{os.getuid()}"
        assert files.user_cache() == place and place.stat().st_mode & 0o077 == 0
        place.chmod(0o777)
        assert files.user_cache() != place, "others could have put code there"
    place = files.user_cache({"XDG_CACHE_HOME": str(tmp_path / "file" / "below")})
    assert place.parent == tmp_path and place.is_dir()
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    place = files.user_cache({"XDG_CACHE_HOME": "relative"})
    assert place == tmp_path / "home" / ".cache" / "diffracing-suite"


def test_a_command_runs_without_home_passwd_entry_and_streams(suite, tmp_path):
    """As in a container that is started with a uid of its own."""
    before = (
        "import pwd\n"
        "def unknown(uid): raise KeyError(f'getpwuid(): uid not found: {uid}')\n"
        f"pwd.getpwuid = unknown\n{CLOSED}"
    )
    env = {"TMPDIR": str(tmp_path)}
    assert suite("example --out it", tmp_path, env, before)[0] == 0
    assert (tmp_path / "it" / "vehicle.toml").stat().st_size > 100
    assert suite("eval --trials 0", tmp_path, env, before)[0] == 2


@pytest.mark.parametrize(
    ("line", "streams", "code", "words"),
    [
        ("eval --trials 0", {"err": "/dev/full"}, 2, ""),
        ("effects", {"out": "/dev/full"}, 1, "the disk is full: standard output;"),
        ("effects", {"out": "/dev/full", "before": UNBUFFERED}, 1, "full: standard output;"),
        # The reader of a pipe has left.
        ("tracks", {"before": "a, b = os.pipe(); os.dup2(b, 1); os.close(a)"}, 1, ""),
        ("--help", {"before": "a, b = os.pipe(); os.dup2(b, 1); os.close(a)"}, 1, ""),
    ],
)
def test_full_streams_end_no_work_but_where_the_result_goes(suite, line, streams, code, words):
    found, said = suite(line, **streams)
    assert found == code and words in said and len(said.splitlines()) == bool(words)


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="Python 3.13 imports nothing there")
def test_a_working_folder_that_is_gone_is_refused_by_what_needs_it(suite, tmp_path):
    gone = "os.mkdir('g'); os.chdir('g'); os.rmdir('../g')"
    for line, code in (("effects", 0), ("example --out it", 2)):
        found, said = suite(line, tmp_path, before=gone)
        assert (found, len(said.splitlines())) == (code, code // 2), said


def test_names_that_are_not_utf8_or_begin_with_a_home_not_written_out_are_refused_before_work(
    capsys, tmp_path, monkeypatch
):
    for line in ("eval --out=~/runs", "diagnose ~/flights"):
        assert "write $HOME for it" in refused(capsys, line)
    monkeypatch.chdir(tmp_path)
    for line in ("eval --out a\udcff", "eval --policy a\udcff"):
        assert r"'a\udcff' is not UTF-8" in refused(capsys, line)
    with pytest.raises(InputError, match="surrogate pair"):
        parse_json('{"name": "\\uDCFF"}', "policy.json")
    assert parse_json('{"name": "\\ud83d\\ude00"}', "it") == {"name": "\U0001f600"}


def test_text_is_written_and_printed_in_any_locale(suite, root, tmp_path):
    files.write_text(tmp_path / "table.md", "in \udcff: 3 °")
    assert (tmp_path / "table.md").read_text(encoding="utf-8") == "in \\udcff: 3 °"
    in_ascii = Program(root, tmp_path, PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert in_ascii("effects") == (0, "")
    code, said = in_ascii("tracks --out " + "é.png".encode().decode("ascii", "surrogateescape"))
    assert code == 2 and "the locale's encoding is ascii; set LC_ALL" in said
    in_ascii.process.communicate()
    code, said = suite("example --out é", tmp_path)
    assert code == 0 and (tmp_path / "é" / "vehicle.toml").exists(), said


def test_a_notebooks_backend_of_charts_is_not_inherited(monkeypatch):
    """Another environment need not have it."""
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.missing")
    assert cli.main(["effects"]) == 0 and os.environ["MPLBACKEND"] == "agg"


def test_the_longest_name_of_a_file_can_be_written(tmp_path):
    name, folder = "é" * 120 + "x" * 10 + ".json", tmp_path / ("f" * 255)  # 255 bytes each
    files.write_json(tmp_path / name, {"a": 1})
    with files.replacing_folder(folder) as beside:
        (beside / "a").touch()
    assert sorted(os.listdir(tmp_path)) == sorted([name, folder.name])


def test_variables_that_change_results_are_set_aside(monkeypatch, capsys):
    kept = {"JAX_PLATFORMS": "cpu", "JAX_DISABLE_JIT": "", "JAX_DEBUG_NANS": "True", "HOME": "/"}
    aside = {"JAX_ENABLE_X64": "1", "JAX_DEBUG_INFS": "perhaps", "JAX_TRANSFER_GUARD": "disallow"}
    own, clean = kept | aside, startup.clean_jax_environment
    full = {"JAX_DEFAULT_MATMUL_PRECISION": "highest"}
    assert clean(own) == sorted(aside) and own == kept | full
    assert clean(own) == [] and own == kept | full, "a process of a command finds its own"
    assert clean(own | {"JAX_DEFAULT_MATMUL_PRECISION": "bfloat16"}) == list(full)
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    assert cli.main(["effects"]) == 0
    assert "JAX_ENABLE_X64 of the environment is ignored" in capsys.readouterr().err


def test_a_compiled_program_that_a_kill_cut_is_compiled_again(tmp_path):
    (tmp_path / "jit_a-1-cache").touch()
    (tmp_path / "jit_b-2-cache").write_bytes(b"whole")
    startup.keep_compiled({"JAX_COMPILATION_CACHE_DIR": str(tmp_path)})
    assert [path.name for path in tmp_path.iterdir()] == ["jit_b-2-cache"]
    startup.keep_compiled({"JAX_COMPILATION_CACHE_DIR": ""})


@pytest.mark.extended
def test_jax_says_of_a_missing_platform_what_we_expect(suite, tmp_path):
    """The words are JAX's own: a new version may choose others."""
    env = {"JAX_PLATFORMS": "rocm", "XDG_CACHE_HOME": str(tmp_path)}
    code, said = suite("train --recipe quick --iterations 1 --out out", tmp_path, env)
    assert code == 2 and len(said.splitlines()) <= 2, said
    assert "JAX_PLATFORMS is 'rocm'" in said


def test_no_output_carries_orders_to_a_terminal_and_no_table_html(capsys):
    console = Console()
    console.say(ESCAPE + "°\u00a0\u2009")
    console.note(ESCAPE)
    console.show(rich_table(table(["policy"], [[ESCAPE]], title=ESCAPE)))
    assert cli.main([ESCAPE]) == 2
    assert cli.main(["eval", "--policy", ESCAPE]) == 2
    said = capsys.readouterr()
    for text in (said.out, said.err):
        assert "\x1b" not in text and "\x07" not in text and "x1b]0;owned" in text
    assert "°\u00a0\u2009" in said.out
    assert printable("a\u202eb") == "a\\u202eb"
    text = markdown(table(["policy"], [['<img src=x onerror="alert(1)">|' + ESCAPE], ["< 0.1"]]))
    assert "<img" not in text and "&lt;img" in text and "| < 0.1 |" in text and "\x1b" not in text


def test_a_cache_that_is_full_or_cut_costs_time_and_no_words(suite):
    words = ["Error writing persistent compilation cache entry for 'f'", "Error reading persistent "
             "compilation cache entry for 'f'"]  # fmt: skip
    warn = f"import warnings\nfor words in {words!r}: warnings.warn(words)\n"
    before = f"from suite.common import startup\nstartup.suppress_warnings()\n{warn}"
    before += f"os.execl(sys.executable, 'python', '-c', {warn!r})"  # as in a process of ours
    assert suite("", before=before) == (0, "")


@pytest.mark.extended
def test_warnings_of_numbers_are_not_for_people(suite, root, tmp_path):
    text = (root / "eval/vehicles/racer5.toml").read_text()
    (tmp_path / "it.toml").write_text(text.replace("mass = 0.75", "mass = 1e300"))
    code, said = suite("eval --vehicle it.toml --trials 1", tmp_path)
    assert code == 2 and len(said.splitlines()) == 1, said


def test_output_is_unbuffered_where_that_is_asked():
    code = "import os; from suite.common.startup import open_streams as o; o(); print(1)"
    for asked, printed in (("1", "1\n"), ("", "")):
        environment = {**os.environ, "PYTHONUNBUFFERED": asked}
        found = python(f"{code}; os._exit(0)", env=environment, check=True)
        assert found.stdout == printed


def test_warnings_of_the_suite_are_lines_without_a_place_in_the_code():
    where = str(Path(startup.__file__).parents[2] / "eval" / "judging" / "judge.py")
    assert startup.format_warning("no action\x07", UserWarning, where, 1) == (
        "warning: no action\\x07\n"
    )
    others = (UserWarning, "/usr/lib/judge.py"), (DeprecationWarning, where)
    for category, file in others:
        assert file in startup.format_warning("no action", category, file, 1, "")
