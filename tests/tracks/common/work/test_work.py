"""Who works and with how many threads; what travels to another machine, and what it must share."""

import errno
import os
from types import MappingProxyType

import pytest

from eval.effects import EFFECTS
from eval.logs.columns import FlightLogError
from suite.cli import main
from suite.common.errors import explain
from tests.support.tools import python
from tracks.common.work import MOST, processes, read_workers, threads
from tracks.common.work.pickling import failure, pack, remote_error, unpack
from tracks.common.work.threads import one_thread_a_product, set_threads, share_threads


@pytest.mark.parametrize(
    ("text", "workers"),
    [
        (None, None),
        ("1", 1),
        ("16", 16),
        ("tcp://10.0.0.1:8786", "tcp://10.0.0.1:8786"),
        ("tls://head.cluster:443", "tls://head.cluster:443"),
        ("head:8786", "tcp://head:8786"),
    ],
)
def test_workers_are_a_number_or_an_address(text, workers):
    assert read_workers(text) == workers


@pytest.mark.parametrize(
    "text",
    ["0", "-1", "two", "", "1.5", str(MOST + 1), "9" * 5000, "tcp://head", "ucx://head:8786", "::"],
)
def test_others_are_refused_with_what_is_allowed(text):
    with pytest.raises(ValueError, match=r"^--workers is '.{0,80}'; allowed is 1 to 256.*tcp://"):
        read_workers(text)


class Stubborn(ValueError):
    """An error that cannot be pickled, so that it cannot travel."""

    def __init__(self, name, value):
        super().__init__(f"{name} is {value}")

    def __reduce__(self):
        raise TypeError("cannot be pickled")


def test_an_error_travels_with_where_it_came_up():
    with pytest.raises(ValueError) as caught:
        EFFECTS.find("linear_dragg")
    there = unpack(pack(failure(caught.value)))
    elsewhere = there._replace(
        root="/opt/suite", traceback=there.traceback.replace(there.root, "/opt/suite")
    )
    found = remote_error(elsewhere)
    assert explain(found) == (2, str(found)) and "linear_drag" in str(found)
    log = unpack(pack(failure(FlightLogError("a.csv", "goes back", "time", 3))))
    assert isinstance(log.error, FlightLogError) and str(log.error).startswith("a.csv: column time")
    other = remote_error(failure(Stubborn("x", 1)))
    assert isinstance(other, ValueError) and str(other) == "Stubborn: x is 1"


def test_a_read_only_table_travels_and_a_function_without_a_name_says_what_to_do():
    assert unpack(pack(MappingProxyType({1: 2}))) == MappingProxyType({1: 2})
    with pytest.raises(ValueError, match=r"functools\.partial"):
        pack(lambda piece: [piece])


@pytest.mark.parametrize(("cores", "wanted"), [(1, "2"), (2, "2"), (16, "16")])
def test_a_thread_a_core_at_least_two_and_no_more_than_a_share_needs(cores, wanted, monkeypatch):
    monkeypatch.setattr(threads, "usable_cores", lambda: cores)
    asked, many = {"NPROC": "1"}, {"NPROC": "99"}
    calls = [(set_threads, {}, wanted), (set_threads, asked, "1"), (share_threads, asked, "1")]
    for change, environment, found in [*calls, (share_threads, many, wanted)]:
        monkeypatch.setattr(os, "environ", environment)
        change()
        assert environment == {"NPROC": found} and threads.threads() == int(found)
    monkeypatch.setattr(os, "environ", {})
    assert threads.threads() == cores


@pytest.mark.parametrize("text", ["", "0", "-1", "two", "1e3", "4097", "9" * 5000, "٣"])
def test_what_is_no_number_is_refused_before_xla_ends_the_process(text, monkeypatch):
    monkeypatch.setattr(os, "environ", {"NPROC": text})
    with pytest.raises(ValueError, match=r"^NPROC is '.{0,40}' in the environment; allowed is 1"):
        set_threads()


GRADIENT = """
import hashlib, sys
import jax, jax.numpy as jnp, numpy as np
from policies.networks import network
from policies.spec import PolicySpec
from tracks.common.work.threads import set_threads
from suite.train.gradient import encoder_gradient
set_threads()
rng = np.random.default_rng(0)
images = jnp.asarray(rng.uniform(size=(640, 24, 32)), jnp.float32)
cotangents = jnp.asarray(rng.normal(size=(640, 192)), jnp.float32)
params = network.init(jax.random.key(0), PolicySpec())
gradient = jax.jit(encoder_gradient)(params, images, cotangents)
digest = hashlib.sha256()
for name in sorted(gradient):
    digest.update(np.asarray(gradient[name]).tobytes())
print(digest.hexdigest())
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores are chosen as on Linux")
def test_the_encoders_gradient_has_the_same_bits_on_any_number_of_cores():
    """One core and all, and as many threads as larger machines have."""
    cores, found = os.sched_getaffinity(0), set()
    for number, pinned in ((None, True), (None, False), ("8", False), ("64", False)):
        environment = {**os.environ, **({} if number is None else {"NPROC": number})}
        # Not in the child: with JAX loaded here, code between fork and exec may block for ever.
        os.sched_setaffinity(0, [min(cores)] if pinned else cores)
        try:
            found.add(python(GRADIENT, env=environment, check=True).stdout)
        finally:
            os.sched_setaffinity(0, cores)
    assert len(found) == 1


def test_processes_that_share_no_lock_are_refused_by_its_place(monkeypatch):
    def refuse(*args):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(processes, "ProcessPoolExecutor", refuse)
    with pytest.raises(OSError) as met:
        processes.worker_pool(1)
    assert explain(met.value) == (2, "read-only file system: /dev/shm")


def test_a_command_gives_numpy_one_thread_and_leaves_a_users_setting(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    one_thread_a_product()
    assert "OPENBLAS_NUM_THREADS" not in os.environ
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert main(["effects"]) == 0
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
