"""Compile a policy.c to a shared library for this machine, and keep it in the user's cache."""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
from pathlib import Path

from policies.formats.c.source import TEMPLATES
from policies.formats.program_inputs import read_model
from policies.spec import PolicyError
from tracks.common.files import replacing_file, user_cache

FLAGS = ("-std=c99", "-O3", "-ffp-contract=fast", "-fPIC", "-shared")
"""Compiler options that every machine supports."""
NATIVE_FLAGS = ("-march=native",)
"""Options for this machine's processor, left out where the compiler does not support them."""
MACROS = ("POLICY_STATE_SIZE", "POLICY_IMAGE_HEIGHT", "POLICY_IMAGE_WIDTH")
"""Macros with the sizes of the inputs, which policy.h must define."""
MACHINE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ENOMEM)
"""Errors of the operating system whose cause is the machine, not the file."""
COMPILE_S = 600.0
"""Time limit of the compiler [s]."""


def find_compiler() -> list[str] | None:
    """Return the C compiler's command: the variable CC, or cc; None where there is none.

    Raises:
        PolicyError: where CC is not a valid command line.
    """
    command = os.environ.get("CC", "cc")
    try:
        words = shlex.split(command) or ["cc"]
    except ValueError as error:
        raise PolicyError(
            f"CC is {command!r} in the environment, which is not a command line ({error}); set it "
            "to one such as gcc, or unset it"
        ) from None
    return words if shutil.which(words[0]) else None


def source_files(policy_c: Path) -> list[Path]:
    """Return policy.c and the policy.h of its folder.

    Raises:
        PolicyError: where one is missing.
    """
    files = [policy_c, policy_c.with_name("policy.h")]
    for file in files:
        if not file.is_file():
            raise PolicyError(
                f"{file}: missing; a policy in C is policy.c and policy.h in one folder, as suite "
                "export --format c writes them"
            )
    return files


def compiled_library(policy_c: Path) -> Path:
    """Return the shared library of a policy.c, compiled now or earlier.

    Its name in the cache is a digest of policy.c, policy.h and the compiler's command. A change of
    another header that they include is not detected.

    Raises:
        PolicyError: where there is no compiler, it refuses the file, or a file cannot be read.
    """
    compiler = find_compiler()
    if compiler is None:
        raise PolicyError(
            f"{policy_c}: a policy in C is compiled before it flies, and there is no C compiler "
            f"({os.environ.get('CC', 'cc')!r} is not on the PATH); install one (such as gcc), or "
            "name it in the environment's CC"
        )
    files = [*source_files(policy_c), TEMPLATES / "library.c"]
    key = hashlib.sha256(repr((compiler, FLAGS, NATIVE_FLAGS, platform.machine())).encode())
    for file in files:
        key.update(hashlib.sha256(read_model(file)).digest())
    # Machines may share a home directory, but not compiled code, since processors differ.
    folder = user_cache() / "c" / (platform.node() or "here")
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    library = folder / f"{key.hexdigest()}.so"
    if not library.is_file():
        with replacing_file(library) as temporary:
            _compile(compiler, files, temporary)
    return library


def _compile(compiler: list[str], files: list[Path], out: Path) -> None:
    """Compile the files (policy.c, policy.h, library.c) to the shared library `out`."""
    policy_c, _, library_c = files
    # A link is not resolved, since policy.h may be only in the folder of the link.
    source = policy_c.absolute()
    arguments = [f"-I{source.parent}", str(source), str(library_c), "-o", str(out), "-lm"]
    message = ""  # of the last attempt, since the first one may only refuse `NATIVE_FLAGS`
    for flags in ((*FLAGS, *NATIVE_FLAGS), FLAGS):
        try:
            result = subprocess.run(
                [*compiler, *flags, *arguments],
                capture_output=True,
                timeout=COMPILE_S,
                stdin=subprocess.DEVNULL,
                env={**os.environ, "LC_ALL": "C"},
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise PolicyError(
                f"{policy_c}: {compiler[0]} did not end within {COMPILE_S:g} s; compile it by hand "
                "to see why"
            ) from None
        if result.returncode == 0:
            return
        message = result.stderr.decode(errors="replace").strip()
        for number in MACHINE_ERRORS:
            if os.strerror(number) in message:
                path = re.search(r"(/\S+): " + re.escape(os.strerror(number)), message)
                raise OSError(number, os.strerror(number), path[1] if path else str(out))
    error = next((line for line in message.splitlines() if "error" in line), message[:300])
    raise PolicyError(
        f"{policy_c}: {compiler[0]} refuses it ({error[:300]}); export it again; C of your own "
        f"needs {', '.join(MACROS)} in policy.h (docs/export.md)"
    )
