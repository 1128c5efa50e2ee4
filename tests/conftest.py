"""Settings of all tests: JAX on the CPU with a cache of compiled code, repeatable hypothesis."""

import gc
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parent.parent
# dm_control is not installed there (docs/install.md).
NO_DM_CONTROL = ["eval/envs/test_envs.py", "eval/envs/test_settings.py"]
collect_ignore = NO_DM_CONTROL if sys.version_info >= (3, 13) else []
TOGETHER = (
    "suite/diagnose",
    "suite/blind",
    "suite/train",
    "suite/diagnose/identify",
    "examples",
    "eval/worlds",
    "suite/judging",
    "policies",
    "suite/delta",
    "suite/loop",
    "suite/experiments",
)
"""Folders whose tests share fixtures and compiled code, those that take longest first."""
AFTER = {"suite/blind": "suite/diagnose"}
"""Folders that run in the process of another one, after it, as they use its compiled code."""

# Before jax is imported anywhere. Compiled code in .cache/jax makes a second run much faster.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
# Tests compile much and run little: slower code that compiles in a fifth of the time, in one part,
# as the other core has tests of its own.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
COMPILER = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
os.environ.setdefault("XLA_FLAGS", COMPILER)
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "agg")

# Tracing makes millions of small objects: rare garbage collection saves a tenth of the time.
gc.set_threshold(100_000, 20, 100)

settings.register_profile(
    "suite",
    deadline=None,
    derandomize=True,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("suite")


@pytest.fixture(scope="session")
def root() -> Path:
    """Return the checkout's root folder."""
    return ROOT


@pytest.fixture
def float64():
    """Let JAX compute in double precision."""
    import jax

    with jax.enable_x64(True):
        yield


def folder_of(path: Path) -> str:
    """Return the folder of `TOGETHER` that has a test file, or the file."""
    name = path.relative_to(ROOT / "tests").as_posix()
    return max((one for one in TOGETHER if name.startswith(f"{one}/")), key=len, default=name)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the folders that take longest first, and single files last: they end at one time."""
    order = {name: number for number, name in enumerate(TOGETHER)}
    items.sort(key=lambda item: order.get(folder_of(item.path), len(order)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Share folders and files among processes with `--dist loadgroup`; pytest 9.2 ignores marks."""
    from xdist.scheduler import LoadScopeScheduling

    class SharedScheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            folder = folder_of(ROOT / nodeid.partition("::")[0])
            return AFTER.get(folder, folder)

    return SharedScheduling(config, log) if config.getvalue("dist") == "loadgroup" else None
