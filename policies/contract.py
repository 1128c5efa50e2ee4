"""The contract of a policy: names, units, frames and scales of its inputs and outputs, as JSON.

The contract is made from a `PolicySpec` and stored in policy files, checkpoints and environments.
The judge (the part of the suite that flies and scores policies) reads it, and refuses a policy
whose inputs it cannot provide. A digest (SHA-256) identifies a contract.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from policies.spec import (
    ACTIONS,
    EXTRAS,
    WIDTH_MOST,
    ActionSpec,
    DepthEncoding,
    PolicyError,
    PolicySpec,
    check_spec,
)
from tracks.common.files import to_json
from tracks.common.toml_table import Table
from tracks.geometry.camera import Camera
from tracks.input.ranges import shown
from tracks.input.reading import InputError, parse_json

KEY = "contract"
"""Name of the contract in files: metadata entry in ONNX, extra file in torch, key in JSON."""
VERSION = 1
"""Version of the contract's layout."""
BODY = "body: x forward, y left, z up"
"""Text for the body frame."""


@dataclass(frozen=True)
class Entry:
    """A part of the state observation."""

    name: str
    size: int
    unit: str
    frame: str
    scale: float = 1.0
    """Factor from the policy's input to `unit`."""


@dataclass(frozen=True)
class Image:
    """The depth image, which is encoded as scale_m / clip(depth, near_m, far_m) - offset."""

    shape: tuple[int, ...]
    encoding: str
    dtype: str
    """Type of a pixel: float32, or uint8 with values from 0 at far_m to 255 at near_m."""
    scale_m: float
    near_m: float
    far_m: float
    offset: float
    pitch_deg: float
    fov_deg: tuple[float, float]
    rays: int
    """n: a pixel is the smallest depth of its n x n rays."""


@dataclass(frozen=True)
class Action:
    """The policy's output; output * scale + offset is in `unit`."""

    kind: str
    names: tuple[str, ...]
    unit: tuple[str, ...]
    frame: str
    scale: tuple[float, ...]
    offset: tuple[float, ...]
    clip: float
    """Outputs are clipped to -clip to clip before scaling; 0: no clipping."""
    limit: str
    """Limits in SI units, as text."""


@dataclass(frozen=True)
class Contract:
    """Inputs and outputs of a policy."""

    rate_hz: float
    state: tuple[Entry, ...]
    image: Image
    action: Action
    memory: tuple[int, ...] | None = None
    """Shape of the hidden state of one policy; None if unknown."""
    speed: float = 1.0
    """Default value of the state entry `speed_input` (wanted speed, 0 to 1)."""
    version: int = VERSION

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the contract as canonical JSON, hex."""
        text = json.dumps(dataclasses.asdict(self), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def to_json(self) -> dict[str, Any]:
        """Return the contract as a dict of JSON values, with its digest."""
        return {**dataclasses.asdict(self), "digest": self.digest}

    @property
    def text(self) -> str:
        """The JSON that goes into a policy's file under `KEY`."""
        return to_json(self.to_json())


# Kind of action -> units, frame and limits.
_ACTIONS = {
    "acceleration": (("m/s^2",) * 3, f"{BODY}; net, without gravity", "length up to 50 m/s^2"),
    "ctbr": (("m/s^2", *("rad/s",) * 3), f"{BODY}; thrust per nominal mass along z",
             "the vehicle file's"),
    "motors": (("share of largest {}",) * 4, "rotors in the vehicle file's order", "0 to 1"),
}  # fmt: skip
# Optional part of the state -> unit and frame.
_EXTRAS = {
    "second_gate": ("m", BODY),
    "gate_axis": ("1", BODY),
    "second_axis": ("1", BODY),
    "speed_input": ("1", "0 (careful) to 1 (a race)"),
}
# Key of a spec -> its name in a contract.
_NAMES = {
    "camera.range_m": "image.far_m",
    "camera.width": "image.shape[-1]",
    "camera.height": "image.shape[-2]",
    "camera.": "image.",
    "depth.scale": "image.scale_m",
    "depth.near": "image.near_m",
    "depth.offset": "image.offset",
}


def contract_of(spec: PolicySpec, memory: tuple[int, ...] | None = None) -> Contract:
    """Return the contract of a policy with `spec`; `memory` is the shape of its hidden state.

    Raises:
        ValueError: for an impossible spec.
    """
    check_spec(spec)
    state = [
        Entry("velocity", 3, "m/s", BODY),
        Entry("world_z", 3, "1", BODY),
        Entry("gate", 3, "m", BODY),
        Entry("last_action", spec.action.size, "as the action in SI units", "as the action"),
    ]
    state += [Entry(key, EXTRAS[key], *_EXTRAS[key]) for key in EXTRAS if getattr(spec, key)]
    camera, depth, action = spec.camera, spec.depth, spec.action
    image = Image(
        spec.image_shape, "inverse_depth", "uint8" if depth.uint8 else "float32", depth.scale,
        depth.near, camera.range_m, depth.offset, camera.pitch_deg, camera.fov_deg, camera.rays,
    )  # fmt: skip
    units, frame, limit = _ACTIONS[action.kind]
    units = tuple(unit.format(action.motors) for unit in units)
    scale, offset = (_each(numbers, action.size) for numbers in (action.scale, action.offset))
    names, clip = ACTIONS[action.kind], action.clip
    output = Action(action.kind, names, units, frame, scale, offset, clip, limit)
    speed = spec.speed if spec.speed_input else 1.0
    contract = Contract(spec.rate_hz, tuple(state), image, output, memory, speed)
    # Reading it back converts numbers, so that 30 and 30.0 give the same digest.
    return Table("", "", dataclasses.asdict(contract)).read(Contract)


def spec_of(contract: Contract, where: str) -> PolicySpec:
    """Return the `PolicySpec` that has this contract; `where` names its source in messages.

    Raises:
        PolicyError: naming the first part that the suite cannot provide, and the alternatives.
    """
    image, action = contract.image, contract.action
    if len(image.shape) not in (2, 3):
        raise PolicyError(
            f"{where}: image.shape is {list(image.shape)}, allowed are (height, width) and (1, "
            "height, width)"
        )
    names = [entry.name for entry in contract.state]
    motors = "speed" if "speed" in "".join(action.unit) and action.kind == "motors" else "thrust"
    memory = contract.memory or ()
    if min(memory, default=1) < 1:
        raise PolicyError(
            f"{where}: memory is {shown(list(memory))}, allowed are sizes of 1 and more, or [] "
            "without memory"
        )
    extras: dict[str, Any] = {key: key in names for key in EXTRAS}
    if len(memory) == 1 and memory[0] <= WIDTH_MOST:
        extras["hidden_size"] = memory[0]
    spec = PolicySpec(
        rate_hz=contract.rate_hz,
        camera=Camera(
            image.pitch_deg, image.fov_deg, image.far_m, image.shape[-1], image.shape[-2],
            image.rays,
        ),
        depth=DepthEncoding(
            image.scale_m, image.near_m, image.offset, len(image.shape) == 3,
            image.dtype == "uint8",
        ),
        action=ActionSpec(
            action.kind, _shortened(action.scale), _shortened(action.offset), motors, action.clip
        ),
        speed=contract.speed,
        **extras,
    )  # fmt: skip
    try:
        check_spec(spec, "")
    except ValueError as error:
        text = str(error)
        for key, name in _NAMES.items():
            text = text.replace(key, name)
        raise PolicyError(f"{where}: {text}") from None
    provided = contract_of(spec, contract.memory)
    for name, theirs, ours in _differences(contract, provided):
        raise PolicyError(
            f"{where}: {name} is {shown(theirs)}, the suite provides {shown(ours)}; convert it "
            "inside the policy's module, and export that with the contract of the environment"
        )
    return spec


def read_contract(text: str | bytes | Mapping[str, Any], where: str) -> Contract:
    """Return the contract in a JSON text, or in the object of that text.

    A list of one number as `action.scale` or `action.offset` counts for all components.

    Raises:
        PolicyError: if it is not a contract of this version, or its digest does not match.
    """
    try:
        data = parse_json(text, where) if isinstance(text, str | bytes) else dict(text)
        if not isinstance(data, dict):
            raise TypeError("expected an object")
        digest = data.pop("digest", None)
        if data.get("version") != VERSION:
            raise TypeError(f"version is {shown(data.get('version'))}, this suite reads {VERSION}")
        contract = Table("", "", data).read(Contract)
    except (InputError, TypeError, ValueError) as error:
        raise PolicyError(
            f"{where}: not a contract ({error}); use the text of env.unwrapped.contract"
        ) from None
    if digest not in (None, contract.digest):
        raise PolicyError(
            f"{where}: its digest is {shown(digest)}, but its contents give "
            f"{contract.digest[:12]}…; it was changed by hand: make it from a PolicySpec or use "
            "that of the environment"
        )
    size, action = len(contract.action.names), contract.action
    scale, offset = _each(action.scale, size), _each(action.offset, size)
    action = dataclasses.replace(action, scale=scale, offset=offset)
    return dataclasses.replace(contract, action=action)


def refuse_differences(contract: Contract, other: Contract, where: str, whose: str) -> None:
    """Refuse a contract that differs from `other`; `whose` names the owner of `other`.

    Raises:
        PolicyError: naming the first part that differs.
    """
    if None in (contract.memory, other.memory):
        contract, other = (dataclasses.replace(c, memory=None) for c in (contract, other))
    for name, theirs, ours in _differences(contract, other):
        raise PolicyError(
            f"{where}: its contract has {name} {shown(theirs)}, {whose} {shown(ours)}; export the "
            "policy again with the contract that it was trained under"
        )


def summary(contract: Contract) -> str:
    """Return the contract as one line of text, for people."""
    image, action = contract.image, contract.action
    levels = "" if image.dtype == "float32" else ", 0 to 255"
    size = sum(entry.size for entry in contract.state)
    scaled = "unscaled" if set(action.scale) == {1.0} and set(action.offset) == {0.0} else "scaled"
    return (
        f"{contract.rate_hz:g} Hz; state of {size} numbers in SI units; image "
        f"{' x '.join(map(str, image.shape))}, camera {image.pitch_deg:g} deg up, "
        f"field of view {image.fov_deg[0]:g} x {image.fov_deg[1]:g} deg, range {image.far_m:g} m, "
        f"{image.scale_m:g}/depth - {image.offset:g}{levels}; action {action.kind} "
        f"[{', '.join(dict.fromkeys(action.unit))}], {scaled}, {action.frame}"
    )


def _each(numbers: tuple[float, ...], size: int) -> tuple[float, ...]:
    """Return one number for each of `size` outputs; a single number counts for all."""
    return tuple(map(float, numbers * size if len(numbers) == 1 else numbers))


def _shortened(numbers: tuple[float, ...]) -> tuple[float, ...]:
    """Return a single number where all are equal."""
    return numbers[:1] if len(set(numbers)) == 1 else numbers


def _differences(first: Any, second: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield (path, first value, second value) for each field in which two dataclasses differ."""
    for key in (entry.name for entry in dataclasses.fields(first)):
        a, b, path = getattr(first, key), getattr(second, key), f"{prefix}{key}"
        if dataclasses.is_dataclass(a):
            yield from _differences(a, b, f"{path}.")
        elif a != b and key == "state":
            for k, (entry_a, entry_b) in enumerate(zip(a, b, strict=False)):
                yield from _differences(entry_a, entry_b, f"state[{k}].")
            yield path, [entry.name for entry in a], [entry.name for entry in b]
        elif a != b:
            yield path, a, b
