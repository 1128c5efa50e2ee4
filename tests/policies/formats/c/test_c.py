"""The exported C: what it looks like, that it compiles without a word, and what it answers."""

import errno
import json
import shlex
import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from policies.formats import model_process as process
from policies.formats.c import arrays, quantised, source
from policies.formats.c.c_file import load_c
from policies.formats.c.compiler import find_compiler
from policies.formats.c.forward import Observed
from policies.formats.c.project import FILES, c_project, native_actions, random_observations
from policies.formats.policy_file import load_policy_checkpoint, save_policy
from policies.formats.spec_json import KEY, labels
from policies.policy import load_policy
from policies.spec import NoAnswer, PolicyError
from tests.support.marks import more
from tests.support.policy_files import SPEC, action_of, lively
from tracks.geometry.camera import Camera

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler: cc, or what CC is")
CAMERA = Camera(width=36, height=20)
ODD = replace(SPEC, camera=CAMERA, hidden_size=50, channels=(6, 96, 32), gate_axis=True)
"""Sizes that fill no block and no group of four pixels."""


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def written(project, folder):
    for file, text in project.files.items():
        (folder / file).write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def exports(tmp_path_factory, checkpoint):
    """Folder, project and checkpoint by name: float32, and both types of odd sizes."""
    spec = replace(ODD, second_axis=True)
    odd = save_policy(tmp_path_factory.mktemp("odd") / "odd", lively(spec, 4), spec, seed=1)
    made = {}
    for name, folder in (("float32", checkpoint), ("odd", odd), ("odd8", odd)):
        stored = load_policy_checkpoint(folder)
        dtype = "int8" if name == "odd8" else "float32"
        observed = random_observations(stored.spec, 40, seed=5)
        project = c_project(stored, folder.name, dtype, observed)
        place = written(project, tmp_path_factory.mktemp(name))
        made[name] = SimpleNamespace(folder=place, checkpoint=stored, project=project)
    return made


@pytest.mark.parametrize("name", ["float32", "odd", "odd8"])
def test_the_contract_of_an_export_is_that_of_the_checkpoint(exports, name):
    stored = exports[name].checkpoint
    contract = stored.config["contract"]
    header = exports[name].project.files["policy.h"]
    assert f'#define POLICY_CONTRACT_SHA256 "{contract["digest"]}"' in header
    texts = labels(stored.spec, name, stored.seed)
    assert json.loads(texts["contract"]) == json.loads(texts[KEY])["contract"] == contract


def answers(policy, observed):
    hidden, found = policy.start(1), []
    for state, image, fresh in zip(*observed, strict=True):
        action, hidden = policy.act(hidden, state[None], image[None], np.array([fresh]))
        found.append(action[0])
    return np.array(found)


STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")


def checked(folder, *flags, name="check"):
    """Compile main.c and policy.c strictly and run them; the finished process."""
    files = [str(folder / file) for file in ("main.c", "policy.c")]
    program = folder / name
    command = [*(find_compiler() or ()), *STRICT, *flags, *files, "-o", str(program), "-lm"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr[:2000]
    return subprocess.run([program], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        more("odd", "-DPOLICY_PLAIN"),
        ("odd", "-march=native"),
        more("odd8", "-march=native"),
    ],
)
def test_it_compiles_strictly_and_runs_under_the_sanitizers(exports, name, kind):
    flags = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", kind)
    done = checked(exports[name].folder, *flags)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "12 steps, 0 numbers wrong" in done.stdout


@pytest.mark.extended
def test_it_does_not_compile_without_its_checks_for_nan_or_with_another_header(exports, tmp_path):
    def said(folder, *flags):
        command = [*(find_compiler() or ()), "-std=c99", *flags, str(folder / "policy.c")]
        made = subprocess.run([*command, "-fsyntax-only"], capture_output=True, text=True)
        return made.stderr

    folder = shutil.copytree(exports["odd"].folder, tmp_path / "copy")
    assert "removes the checks for NaN" in said(folder, "-ffast-math")
    assert said(folder) == said(folder, "-ffast-math", "-fno-finite-math-only") == ""
    shutil.copy(exports["odd8"].folder / "policy.h", folder)
    assert "are of two exports" in said(folder)
    with pytest.raises(PolicyError, match="are of two exports"):
        load_c(folder, trust=True)


def test_its_tanh_is_tanh_however_large_its_argument(exports, tmp_path):
    folder, program = exports["odd"].folder, tmp_path / "tanh"
    code = """
    #include <stdio.h>
    #include "policy.c"
    int main(void) {
        for (int k = -400; k <= 400; k++) { printf("%.9g\\n", (double)tanh_of(0.1f * (float)k)); }
        return 0;
    }
    """
    (tmp_path / "tanh.c").write_text(code)
    command = [*(find_compiler() or ()), f"-I{folder}", str(tmp_path / "tanh.c")]
    subprocess.run([*command, "-o", str(program), "-lm"], check=True, capture_output=True)
    said = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    wanted = np.tanh(0.1 * np.arange(-400, 401))
    np.testing.assert_allclose(np.array(said.split(), float), wanted, atol=1e-6)


def test_the_vectors_find_one_wrong_weight(exports, tmp_path):
    folder = shutil.copytree(exports["odd"].folder, tmp_path / "wrong")
    text = (folder / "policy.c").read_text()
    at = text.index("action_weight[")
    at = text.index("{", at) + 1
    (folder / "policy.c").write_text(text[:at] + "9.0f +" + text[at:])
    assert checked(folder).returncode == 1


@pytest.mark.parametrize(("name", "steps"), [more("float32", 300), ("odd", 100)])
def test_parity_with_jax_over_many_steps_with_memory(exports, name, steps):
    export = exports[name]
    observed = random_observations(export.checkpoint.spec, steps, seed=9)
    policy = load_policy(export.folder, trust=True)
    assert policy.spec == export.checkpoint.spec
    wanted = native_actions(export.checkpoint.params, policy.spec, observed)
    assert np.abs(wanted).std() > 0.5
    np.testing.assert_allclose(answers(policy, observed), wanted, atol=1e-4, rtol=0)


def test_int8_answers_as_worked_out_and_near_the_policy(exports):
    export = exports["odd8"]
    params, spec = export.checkpoint.params, export.checkpoint.spec
    observed = random_observations(spec, 60, seed=5)
    found = answers(load_c(export.folder, trust=True), observed)
    wanted = quantised.actions(params, spec, export.project.layers, observed)
    np.testing.assert_allclose(found, wanted, atol=0.05, rtol=0)
    native = native_actions(params, spec, observed)
    assert np.abs(found - native).max() < 0.1 * np.abs(native).max()


def test_sums_that_32_bits_do_not_hold_are_refused(exports, monkeypatch):
    weight = np.full((140_000, 2), 1, np.int8)
    quantised.check_sums("image", weight)
    weight[:, 1] = -127
    with pytest.raises(PolicyError, match="'image': the sum over its 140000 inputs may reach 22"):
        quantised.check_sums("image", weight)
    stored = exports["odd"].checkpoint
    monkeypatch.setattr(quantised, "SUM_MOST", 1000)
    with pytest.raises(PolicyError, match="allowed for int8 is up to 1000; export it as float32"):
        c_project(stored, "odd", "int8", random_observations(stored.spec, 2))


def test_a_row_stands_alone_and_a_fresh_one_has_no_memory(exports):
    policy = load_c(exports["odd"].folder, trust=True)
    observed = random_observations(policy.spec, 6, seed=2)
    alone = answers(policy, observed)
    hidden = policy.start(3)
    for k, (state, image, _) in enumerate(zip(*observed, strict=True)):
        states, images = (np.stack([np.zeros_like(x), x, x[::-1]]) for x in (state, image))
        action, hidden = policy.act(hidden, states, images, np.full(3, k == 0))
        assert action[1].tobytes() == alone[k].tobytes()
    again = Observed(*(np.concatenate([x, x]) for x in observed))
    assert answers(policy, again)[6:].tobytes() == alone.tobytes()


def test_what_is_not_finite_is_answered_with_nan_and_forgotten(exports):
    policy = load_c(exports["odd"].folder, trust=True)
    state, image, _ = random_observations(policy.spec, 2)
    before, none = policy.start(1), np.zeros(1, bool)
    for bad in (np.nan, np.inf):
        for which in (0, 1):
            one, picture = state[:1].copy(), image[:1].copy()
            (one, picture)[which].ravel()[-1] = bad
            action, after = policy.act(before, one, picture, none)
            assert np.isnan(action).all() and (after == before).all()


def test_what_is_not_trusted_or_compiled_is_said_in_plain_words(exports, tmp_path, monkeypatch):
    with pytest.raises(PolicyError, match="pass --trust"):
        load_policy(exports["odd"].folder / "policy.c")
    folder = shutil.copytree(exports["odd"].folder, tmp_path / "copy")
    (folder / "policy.c").write_text('#include "policy.h"\nvoid policy_reset(policy_state *s) {')
    old = tmp_path / "old"  # a compiler without -march=native
    old.write_text('#!/bin/sh\ncase "$*" in *native*) echo "error: native" >&2; exit 1;; esac\n'
                   f'exec {shlex.join(find_compiler())} "$@"\n')  # fmt: skip
    old.chmod(0o700)
    for command in (None, str(old)):
        if command:
            monkeypatch.setenv("CC", command)
        with pytest.raises(PolicyError, match="refuses it .*error: expected"):
            load_c(folder, trust=True)
    monkeypatch.undo()
    (folder / "policy.h").unlink()
    with pytest.raises(PolicyError, match="policy.h: missing"):
        load_c(folder, trust=True)
    full = tmp_path / "full"
    said = "policy.c:9: error writing to /t/x.s: No space left on device"
    full.write_text(f"#!/bin/sh\necho {said} >&2\nexit 1\n")
    full.chmod(0o700)
    monkeypatch.setenv("CC", str(full))
    with pytest.raises(OSError) as met:
        load_c(exports["odd"].folder, trust=True)
    assert met.value.errno == errno.ENOSPC and met.value.filename == "/t/x.s"
    wrong = {"no-such-compiler": "no C compiler", "gcc '-O2": "not a command line .No closing quot"}
    for command, said in wrong.items():
        monkeypatch.setenv("CC", command)
        with pytest.raises(PolicyError, match=said):
            load_c(exports["odd"].folder, trust=True)


@pytest.mark.extended
def test_a_folder_of_links_flies_with_its_own_header(exports, tmp_path):
    """As caches keep files: by what they hold, in another folder and under other names."""
    (tmp_path / "linked").mkdir()
    for name in ("policy.c", "policy.h"):
        kept = tmp_path / f"kept-{name[-1]}"
        # Another text than other tests compile, so that no library of theirs is found.
        kept.write_text((exports["odd"].folder / name).read_text() + "/* kept */\n")
        (tmp_path / "linked" / name).symlink_to(kept)
    assert load_c(tmp_path / "linked", trust=True).name == "odd.c"


@pytest.mark.extended
def test_a_name_with_signs_that_c_reads_otherwise_comes_back(exports, tmp_path):
    """Of two ? and a third sign C99 makes another sign, a backslash even."""
    name = r'run ??) "one" ??/ \ü'
    written(c_project(exports["odd"].checkpoint, name), tmp_path)
    assert checked(tmp_path).returncode == 0
    assert load_c(tmp_path, trust=True).name == f"{name}.c"


FOREIGN = """
#include "policy.h"
static int steps;
void policy_reset(policy_state *state) {{ {reset} }}
void policy_step(policy_state *state, const float *observation, const float *image, float *action)
{{
    state->seen += observation[0] + image[0] * 0.0f;
    action[0] = action[1] = action[2] = {answer};
    steps++;
}}
"""
DOOR = """
#define POLICY_STATE_SIZE {size}
#define POLICY_IMAGE_HEIGHT 24
#define POLICY_IMAGE_WIDTH 32
typedef struct { float seen; } policy_state;
void policy_reset(policy_state *state);
void policy_step(policy_state *, const float *, const float *, float *);
"""


def foreign(folder, answer, size=12, reset="state->seen = 0.0f;"):
    (folder / "policy.c").write_text(FOREIGN.format(answer=answer, reset=reset))
    (folder / "policy.h").write_text(DOOR.replace("{size}", str(size)))
    return load_c(folder, trust=True)


def test_any_c_with_this_door_flies_but_none_with_a_memory_of_its_own(tmp_path):
    policy = foreign(tmp_path, "state->seen")
    assert policy.name == "policy.c"
    assert (policy.spec.rate_hz, policy.state_bytes) == (30.0, 4)
    with pytest.raises(PolicyError, match="keep all memory of the policy in policy_state"):
        foreign(tmp_path, "(float)steps")
    for size in ("15", "12\n#define POLICY_ACTION_SIZE 4"):
        with pytest.raises(PolicyError, match="expected by its POLICY_JSON"):
            foreign(tmp_path, "state->seen", size)


def test_c_whose_reset_leaves_memory_is_refused(tmp_path):
    with pytest.raises(PolicyError, match="after policy_reset its answer still depends on the"):
        foreign(tmp_path, "state->seen", reset="(void)state;")


def test_c_without_its_sizes_is_refused_with_their_names(tmp_path):
    with pytest.raises(PolicyError, match="own needs POLICY_STATE_SIZE, POLICY_IMAGE_HEIGHT"):
        foreign(tmp_path, "0.0f", "12\n#undef POLICY_STATE_SIZE")


def test_c_without_its_functions_is_refused_with_what_it_lacks(tmp_path):
    (tmp_path / "policy.h").write_text(DOOR.replace("{size}", "12"))
    (tmp_path / "policy.c").write_text('#include "policy.h"\n')
    with pytest.raises(PolicyError, match="C .* cannot load it .*must define policy_reset"):
        load_c(tmp_path, trust=True)


@pytest.mark.parametrize(
    ("fault", "how"),
    [("for (;;) {}", "gave no answer within 1 s"), ("action = 0; *action = 0;", "SIGSEGV")],
)
def test_c_that_hangs_or_crashes_in_flight_takes_nothing_with_it(fault, how, tmp_path, monkeypatch):
    """The next trial's question goes to a fresh process."""
    monkeypatch.setattr(process, "ANSWER_S", 1.0)
    policy = foreign(tmp_path, f"state->seen;\n    if (observation[1] > 1e6f) {{ {fault} }}")
    calm = np.tile(np.arange(12.0), (2, 1))
    before = action_of(policy, calm)
    with pytest.raises(NoAnswer, match=f"with compiled C .*{how}"):
        action_of(policy, calm * 1e7)
    assert action_of(policy, calm).tobytes() == before.tobytes()


def test_it_includes_only_math_and_its_header_says_sizes_and_weights(exports):
    export = exports["float32"]
    lines = (export.folder / "policy.c").read_text().splitlines()
    included = [line for line in lines if line.startswith("#include")]
    assert included == ["#include <math.h>", '#include "policy.h"']
    header = (export.folder / "policy.h").read_text()
    for said in ("POLICY_STATE_SIZE 12", "POLICY_IMAGE_HEIGHT 24", "POLICY_RATE_HZ 33.0f"):
        assert f"#define {said}" in header
    assert export.checkpoint.config["weights"]["sha256"] in header
    for name in ("odd", "odd8"):
        export = exports[name]
        assert set(export.project.files) == set(FILES)
        policy = load_c(export.folder, trust=True)
        assert policy.state_bytes == source.memory_bytes(policy.spec, name.endswith("8"))


def test_literals_are_exact():
    for value in np.random.default_rng(0).normal(size=1000).astype(np.float32) * np.float32(1e-3):
        assert np.float32(arrays.float_text(float(value))[:-1]) == value


def test_int8_needs_flights(exports):
    checkpoint = exports["float32"].checkpoint
    with pytest.raises(PolicyError, match="needs observations of flights"):
        c_project(checkpoint, "tiny", "int8")
