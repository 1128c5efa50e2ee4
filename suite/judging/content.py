"""The files of which a policy consists: their SHA-256, and their content for other processes.

A policy is a folder (checkpoint or export in C) or a single file with the files that it refers to.
"""

from __future__ import annotations

import atexit
import functools
import hashlib
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from policies import shipped
from policies.policy import Policy, load_policy
from tracks.common.files import digest_of
from tracks.input.reading import parse_json


def policy_files(name_or_path: str | Path) -> dict[str, Path]:
    """Return the files of which a policy consists, by their path within its folder.

    Other files of the folder, such as its card, do not belong to the policy.
    """
    from policies.formats.checkpoint import CONFIG, WEIGHTS

    path = shipped.locate(name_or_path)
    if path.is_dir():
        names = (CONFIG, WEIGHTS) if (path / CONFIG).exists() else ("policy.h", "policy.c")
        return {name: path / name for name in names if (path / name).is_file()}
    if path.suffix == ".c":
        return {"policy.h": path.with_name("policy.h"), path.name: path}
    if path.suffix == ".onnx":
        from policies.formats.onnx_file import files_of

        # External data of a model are next to the file itself, and not next to a link to it.
        model, *data = files_of(path)
        folder = model.resolve().parent
        return {path.name: model, **{str(file.relative_to(folder)): file for file in data}}
    return {path.name: path}


def policy_digest(name_or_path: str | Path) -> str:
    """Return the SHA-256 of the files of which a policy consists, in hexadecimal digits."""
    return PolicyContent.of(name_or_path).digest


@dataclass(frozen=True)
class PolicyContent:
    """The content of a policy's files; a call returns the policy, loaded once in each process."""

    name: str
    """Names of the policy's folder and the one around it, from which its label is made."""
    file: str
    """Name of the file that is loaded; "" loads the folder."""
    files: tuple[tuple[str, bytes], ...] = field(repr=False)
    """The files: path within the folder, and content."""
    trust: bool
    """Whether a file that can run code may be loaded."""

    @classmethod
    def of(cls, name_or_path: str | Path, trust: bool = False) -> PolicyContent:
        """Return the content of a policy on this machine."""
        path = shipped.locate(name_or_path).absolute()
        folder, file = (path, "") if path.is_dir() else (path.parent, path.name)
        contents = policy_files(name_or_path).items()
        files = tuple((name, entry.read_bytes()) for name, entry in contents)
        real = folder.resolve()
        return cls(str(Path(real.parent.name, real.name)), file, files, trust)

    @property
    def digest(self) -> str:
        """The SHA-256 of the files, in hexadecimal digits."""
        digest = hashlib.sha256()
        for name, data in self.files:
            digest.update(Path(name).name.encode() + b"\0" + data)
        return digest.hexdigest()

    @property
    def settings_digest(self) -> str | None:
        """The SHA-256 of the training's settings without the seed; None if they are not recorded.

        It includes the number of finished iterations.
        """
        from policies.formats.checkpoint import CONFIG

        text = dict(self.files).get(CONFIG, b"{}")
        training = parse_json(text, CONFIG).get("training")
        settings = training.get("config") if isinstance(training, dict) else None
        if not isinstance(settings, dict):
            return None
        return digest_of([{**settings, "seed": None}, training.get("iteration")])

    def __call__(self) -> Policy:
        """Return the policy.

        Raises:
            PolicyError: if it cannot be loaded.
        """
        return _loaded(self)


@functools.lru_cache(maxsize=4)
def _loaded(content: PolicyContent) -> Policy:
    """Write the files into a temporary folder and return the policy loaded from it.

    The folder stays until the process ends, because some kinds of policy read their files again.
    """
    folder = tempfile.mkdtemp(prefix="suite-policy-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, data in content.files:
        path = Path(folder, content.name, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return load_policy(Path(folder, content.name, content.file), content.trust)
