"""Odd surroundings: no home, no streams, other locales, JAX's variables, a machine in trouble."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite import cli
from suite.common import startup
from suite.common.console import Console
from suite.common.errors import FAILED, UNUSABLE, explain
from tracks.common import files
from tracks.common.grid import markdown, rich_table, table
from tracks.common.names import printable
from tracks.input.reading import InputError, parse_json

ESCAPE = "a\x1b]0;owned\x07\x1b[31mb"


def suite(root, args, env=None, closed="", **options):
    """Run a command line in a process of its own, in an environment that holds `env` alone.

    `closed` are the shell's redirections that close streams.
    """
    code = "import sys; sys.argv[0] = 'suite'; from suite.cli import entry; entry()"
    paths = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
    wanted = {"PATH": os.environ["PATH"], "PYTHONPATH": paths} | (env or {})
    command = ["sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", code, *args]
    return subprocess.run(command, env=wanted, timeout=120, capture_output=True, **options)


def test_without_a_home_there_is_a_place_of_ones_own(tmp_path, monkeypatch):
    def nobody():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nobody)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    place = files.user_cache()
    assert place == tmp_path / f"diffracing-suite-{os.getuid()}" and files.user_cache() == place
    assert place.stat().st_mode & 0o077 == 0
    place.chmod(0o777)
    assert files.user_cache() != place, "others could have put code there"


def test_a_home_that_cannot_be_written_is_none(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    place = files.user_cache({"XDG_CACHE_HOME": str(tmp_path / "file" / "below")})
    assert place.parent == tmp_path and place.is_dir()
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    place = files.user_cache({"XDG_CACHE_HOME": "relative"})
    assert place == tmp_path / "home" / ".cache" / "diffracing-suite"


def test_a_command_runs_without_home_passwd_entry_and_streams(root, tmp_path):
    """As in a container that is started with a uid of its own."""
    code = (
        "import os, pwd, sys\n"
        "def unknown(uid): raise KeyError(f'getpwuid(): uid not found: {uid}')\n"
        "pwd.getpwuid = unknown\n"
        "for number in (0, 1, 2): os.close(number)\n"
        "sys.stdin = sys.stdout = sys.stderr = None\n"  # as Python itself finds them closed
        "sys.argv = ['suite', 'tracks', 'zigzag', '--out', 'out.png']\n"
        "from suite.cli import entry\n"
        "entry()\n"
    )
    env = {"PATH": os.environ["PATH"], "PYTHONPATH": str(root), "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=env, cwd=tmp_path, timeout=120)
    assert done.returncode == 0 and (tmp_path / "out.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("closed", "line", "code", "said", "env"),
    [
        ("<&- >&- 2>&-", "eval --trials 0", 2, b"", {}),
        (">&-", "effects", 0, b"", {}),
        ("2>/dev/full", "eval --trials 0", 2, b"", {}),
        (">/dev/full", "effects", 1, b"the disk is full: standard output;", {}),
        (">/dev/full", "effects", 1, b"full: standard output;", {"PYTHONUNBUFFERED": "1"}),
    ],
)
def test_closed_and_full_streams_end_no_work_but_where_the_result_goes(
    root, closed, line, code, said, env
):
    done = suite(root, line.split(), env, closed=closed)
    assert done.returncode == code and b"Traceback" not in done.stderr
    assert said in done.stderr and len(done.stderr.splitlines()) == bool(said)


def test_a_working_folder_that_is_gone_is_refused_by_what_needs_it(root, tmp_path):
    gone = (
        f"import os; os.mkdir('g'); os.chdir('g'); os.rmdir('../g'); import sys\n"
        f"sys.path.insert(0, {str(root)!r}); sys.argv[0] = 'suite'\n"
    )
    for line, code in (("effects", 0), ("tracks zigzag --out it.png", 2)):
        run = f"{gone}sys.argv[1:] = {line.split()!r}\nfrom suite.cli import entry; entry()"
        done = subprocess.run([sys.executable, "-c", run], cwd=tmp_path, capture_output=True)
        assert (done.returncode, len(done.stderr.splitlines())) == (code, code // 2), done.stderr


def test_a_home_that_the_shell_did_not_write_out_is_refused(capsys):
    for line in (["eval", "--out=~/runs"], ["diagnose", "~/flights"]):
        assert cli.main(line) == 2
        assert "write $HOME for it" in capsys.readouterr().err


def test_names_that_are_not_utf8_are_refused_before_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for line in (["eval", "--out", "a\udcff"], ["eval", "--policy", "a\udcff"]):
        assert cli.main(line) == 2
        said = capsys.readouterr().err
        assert r"'a\udcff' is not UTF-8" in said and len(said.splitlines()) == 1
    with pytest.raises(InputError, match="surrogate pair"):
        parse_json('{"name": "\\uDCFF"}', "policy.json")
    assert parse_json('{"name": "\\ud83d\\ude00"}', "it") == {"name": "\U0001f600"}


def test_text_is_written_and_printed_in_any_locale(root, tmp_path):
    files.write_text(tmp_path / "table.md", "in \udcff: 3 °")
    assert (tmp_path / "table.md").read_text(encoding="utf-8") == "in \\udcff: 3 °"
    env = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = suite(root, ["effects"], env)
    assert done.returncode == 0 and b"Traceback" not in done.stderr
    done = suite(root, ["tracks", "--out", "é.png"], env, cwd=tmp_path)
    assert done.returncode == 2 and b"the locale's encoding is ascii; set LC_ALL" in done.stderr
    # A notebook's commands inherit its backend, which another environment need not have.
    env = {"LC_ALL": "C", "MPLBACKEND": "module://matplotlib_inline.missing"}
    done = suite(root, ["tracks", "zigzag", "--out", "é.png"], env, cwd=tmp_path)
    assert done.returncode == 0 and (tmp_path / "é.png").exists(), done.stderr


@pytest.mark.parametrize("name", ["EFBIG", "EIO", "ESTALE", "ENOTCONN", "EMFILE", "EREMOTEIO"])
def test_trouble_of_the_machine_is_no_bug(name):
    number = getattr(errno, name)
    code, said = explain(OSError(number, os.strerror(number))) or (None, "")
    assert code == FAILED and os.strerror(number).lower() in said


def test_a_mistake_of_ours_is_one():
    assert explain(OSError(errno.EBADF, "Bad file descriptor")) is None


@pytest.mark.parametrize("write", ["file", "folder"])
def test_a_full_disk_is_said_with_the_name(tmp_path, write):
    beside = files.replacing_file if write == "file" else files.replacing_folder
    with pytest.raises(OSError) as met:
        with beside(tmp_path / "trials.parquet"):
            raise OSError(errno.ENOSPC, "No space left on device")
    code, said = explain(met.value) or (None, "")
    assert code == FAILED and said.startswith("the disk is full: ") and "trials.parquet;" in said


def test_the_longest_name_of_a_file_can_be_written(tmp_path):
    name = "é" * 120 + "x" * 10 + ".json"  # 255 bytes
    files.write_json(tmp_path / name, {"a": 1})
    folder = tmp_path / ("f" * 255)
    with files.replacing_folder(folder) as beside:
        (beside / "a").touch()
    # A kill between the two renames: the next command puts the new one in its place.
    part = tmp_path / f".{'f' * 200}-999999999-abcdefgh.part"
    (part / "replaced").mkdir(parents=True)
    os.rename(folder, part / folder.name)
    files.sweep_parts(tmp_path)
    assert sorted(os.listdir(tmp_path)) == sorted([name, folder.name])


def test_variables_that_change_results_are_set_aside(monkeypatch, capsys):
    kept = {"JAX_PLATFORMS": "cpu", "JAX_DISABLE_JIT": "", "JAX_DEBUG_NANS": "True", "HOME": "/"}
    aside = {"JAX_ENABLE_X64": "1", "JAX_DEBUG_INFS": "perhaps", "JAX_TRANSFER_GUARD": "disallow"}
    own = kept | aside
    full = {"JAX_DEFAULT_MATMUL_PRECISION": "highest"}
    assert startup.clean_jax_environment(own) == sorted(aside) and own == kept | full
    assert startup.clean_jax_environment(own) == [] and own == kept | full, (
        "a process of a command finds its own"
    )
    assert startup.clean_jax_environment(
        own | {"JAX_DEFAULT_MATMUL_PRECISION": "bfloat16"}
    ) == list(full)
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    assert cli.main(["effects"]) == 0
    assert "JAX_ENABLE_X64 of the environment is ignored" in capsys.readouterr().err


def test_a_compiled_program_that_a_kill_cut_is_compiled_again(tmp_path):
    (tmp_path / "jit_a-1-cache").touch()
    (tmp_path / "jit_b-2-cache").write_bytes(b"whole")
    startup.keep_compiled({"JAX_COMPILATION_CACHE_DIR": str(tmp_path)})
    assert [path.name for path in tmp_path.iterdir()] == ["jit_b-2-cache"]
    startup.keep_compiled({"JAX_COMPILATION_CACHE_DIR": ""})


def test_a_platform_that_is_not_there_is_one_line(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    error = RuntimeError("Unable to initialize backend 'cuda': no device\nmore\nlines")
    code, said = explain(error) or (None, "")
    assert code == UNUSABLE and said.startswith("JAX_PLATFORMS is 'cuda'") and "\n" not in said


def test_a_display_that_mujoco_does_not_have_is_one_line():
    error = RuntimeError("invalid value for environment variable MUJOCO_GL: glx2")
    assert explain(error) == (UNUSABLE, f"{error}; unset it")


def test_jax_says_of_a_missing_platform_what_we_expect(root, tmp_path):
    """The words are JAX's own: a new version may choose others."""
    env = {"JAX_PLATFORMS": "rocm", "XDG_CACHE_HOME": str(tmp_path)}
    done = suite(root, ["train", "--recipe", "quick", "--iterations", "1", "--out", "out"], env,
                 cwd=tmp_path)  # fmt: skip
    assert done.returncode == 2 and len(done.stderr.splitlines()) <= 2, done.stderr
    assert b"JAX_PLATFORMS is 'rocm'" in done.stderr


def test_no_output_carries_orders_to_a_terminal(capsys):
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


def test_no_table_carries_html():
    text = markdown(table(["policy"], [['<img src=x onerror="alert(1)">|' + ESCAPE], ["< 0.1"]]))
    assert "<img" not in text and "&lt;img" in text and "| < 0.1 |" in text and "\x1b" not in text


def test_a_vehicle_is_written_so_that_it_can_be_read(tmp_path):
    vehicle = load_vehicle("racer5")
    save_vehicle(vehicle, tmp_path / "it.toml", f"of {ESCAPE}\x0cand \x00 \x7f")
    assert load_vehicle(tmp_path / "it.toml") == vehicle
    text = (tmp_path / "it.toml").read_text().replace('"racer5"', r'"a\u001b[31m"')
    (tmp_path / "it.toml").write_text(text)
    with pytest.raises(ValueError, match="a printable text"):
        load_vehicle(tmp_path / "it.toml")


def test_a_cache_that_is_full_or_cut_costs_time_and_no_words(root):
    words = ["Error writing persistent compilation cache entry for 'f'", "Error reading persistent "
             "compilation cache entry for 'f'"]  # fmt: skip
    warn = f"import warnings\nfor words in {words!r}: warnings.warn(words)"
    code = "import os, sys\nfrom suite.common import startup\nstartup.suppress_warnings()\n"
    code += f"{warn}\n"
    code += f"os.execl(sys.executable, 'python', '-c', {warn!r})"  # as in a process of ours
    env = {"PATH": os.environ["PATH"], "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, timeout=60)
    assert done.returncode == 0 and not done.stderr, done.stderr


def test_warnings_of_numbers_are_not_for_people(root, tmp_path):
    text = (Path(cli.__file__).parents[1] / "eval/vehicles/racer5.toml").read_text()
    (tmp_path / "it.toml").write_text(text.replace("mass = 0.75", "mass = 1e300"))
    done = suite(root, ["eval", "--vehicle", "it.toml", "--trials", "1"], cwd=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr


@pytest.mark.parametrize("asked", [True, False])
def test_output_is_unbuffered_where_that_is_asked(asked):
    code = (
        "import os; from suite.common.startup import open_streams as o; o(); print(1); os._exit(0)"
    )
    environment = {**os.environ, "PYTHONUNBUFFERED": "1" if asked else ""}
    args = [sys.executable, "-c", code]
    found = subprocess.run(args, env=environment, capture_output=True, text=True, check=True)
    assert found.stdout == ("1\n" if asked else "")
