"""Write the text of policy.h and policy.c for one of the suite's policies, from C templates."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from policies.contract import contract_of
from policies.formats.c import arrays
from policies.formats.c.arrays import array_text, blocked, float_text, multiply_adds, padded
from policies.formats.c.quantised import Quantised
from policies.formats.policy_file import PolicyCheckpoint
from policies.networks.network import LEAK, flat_features
from policies.spec import EXTRAS, PolicySpec
from tracks.common.provenance import VERSION

TEMPLATES = Path(__file__).resolve().parent / "templates"
"""Folder of the C templates."""
TANH_TERMS = 12
"""Number of terms of tanh's continued fraction; for inputs up to 8 the error is below 4e-7."""
_OBSERVATION = (
    ("velocity in body axes", "m/s"),
    ("third row of R: the world's z axis in body axes, (0, 0, 1) when level", "1"),
    ("from the drone to the centre of the next gate, in body axes", "m"),
)
"""Meaning and unit of the first three parts of the state."""
_ACTIONS = {
    "acceleration": """the wanted net acceleration in current body axes [m/s^2]. Gravity is
 *   compensated: an action of zeros keeps the velocity. The wanted specific force is
 *   f = R action + (0, 0, 9.81); the wanted body z axis is along f, the collective thrust over the
 *   mass is max(0, f . body z), the heading follows the direction to the gate, and the body rates
 *   are attitude gain times attitude error.""",
    "ctbr": """collective thrust per nominal mass along body z [m/s^2], then the
 *   body rates about x, y and z [rad/s], which the vehicle's rate loop follows.""",
    "motors": "the four rotors' shares of their largest $WHAT, 0 to 1.",
}
"""Kind of action -> meaning, for the comment in the header."""
_EXTRA = {
    "second_gate": ("to the centre of the gate after the next (or the last), in body axes", "m"),
    "gate_axis": ("the next gate's flight direction, a unit vector in body axes", "1"),
    "second_axis": ("the flight direction of the gate after it (or of the last)", "1"),
    "speed_input": ("commanded speed, 0 (careful) to 1", "1"),
}
"""Optional part of the state -> meaning and unit."""


def sources(
    checkpoint: PolicyCheckpoint, name: str, label: str, layers: Mapping[str, Quantised] | None
) -> dict[str, str]:
    """Return the texts of policy.h and policy.c.

    `label` is JSON with provenance, spec and contract of the policy, from `spec_json.embed`.
    `layers` are the quantised large layers; None for float32.
    """
    definitions = _definitions(checkpoint, layers)
    values = _values(checkpoint, name, label, layers)
    kernels = ("head.c", definitions, "common.c", "int8.c" if layers else "float32.c")
    body = [_fill_template(part, values) if part.endswith(".c") else part for part in kernels]
    return {"policy.h": _fill_template("header.h", values), "policy.c": "".join(body)}


def constants(
    checkpoint: PolicyCheckpoint, layers: Mapping[str, Quantised] | None
) -> dict[str, np.ndarray]:
    """Return the arrays of policy.c by name, float32 and int8."""
    params, spec = checkpoint.params, checkpoint.spec
    constants = arrays.small_arrays(params, spec)
    if layers is None:
        large = arrays.matrices(params, spec)
        constants |= {f"{name}_weight": blocked(weight) for name, weight in large.items()}
        return {**constants, "zeros": np.zeros(16, np.float32)}
    for name, layer in layers.items():
        constants[f"{name}_weight"] = blocked(layer.weight)
        constants[f"{name}_scale"], constants[f"{name}_offset"] = layer.scale, layer.offset
    return constants


def work_sizes(spec: PolicySpec) -> tuple[int, int, int]:
    """Return the lengths of the C code's two float arrays, and of its int8 array.

    The arrays hold the outputs of the layers in turn; only int8 code has the third.
    """
    rows, columns = spec.camera.height // 4, spec.camera.width // 4
    first = rows * columns * spec.channels[0]
    second = (rows - 2) * (columns - 2) * spec.channels[1]
    third = flat_features(spec)
    hidden_padded, gates = padded(spec.hidden_size), padded(3 * spec.hidden_size)
    return (
        max(first, third, gates),
        max(4 * rows * columns, second, hidden_padded),
        max(first, second, third, hidden_padded),
    )


def memory_bytes(spec: PolicySpec, quantised: bool) -> int:
    """Return the size of the C struct `policy_state` [bytes]."""
    first, second, third = work_sizes(spec)
    floats = padded(spec.hidden_size) + padded(3 * spec.hidden_size) + first + second
    return 4 * (floats + 1) + 2 * (third + third % 2) * quantised


def constant_bytes(checkpoint: PolicyCheckpoint, layers: Mapping[str, Quantised] | None) -> int:
    """Return the size of all constants in policy.c [bytes]."""
    return sum(value.nbytes for value in constants(checkpoint, layers).values())


def _definitions(checkpoint: PolicyCheckpoint, layers: Mapping[str, Quantised] | None) -> str:
    """Return the C definitions of all constants."""
    texts = [array_text(name, value) for name, value in constants(checkpoint, layers).items()]
    for name, layer in (layers or {}).items():
        inverse = float_text(float(np.float32(layer.inverse)))
        texts.append(f"#define {name.upper()}_INVERSE {inverse}\n")
        texts.append(f"#define {name.upper()}_ZERO ({layer.zero})\n")
    return "".join(texts)


def _fill_template(template: str, values: Mapping[str, Any]) -> str:
    return Template((TEMPLATES / template).read_text(encoding="utf-8")).substitute(values)


def _values(
    checkpoint: PolicyCheckpoint,
    name: str,
    label: str,
    layers: Mapping[str, Quantised] | None,
) -> dict[str, Any]:
    """Return the values of the templates' placeholders."""
    spec = checkpoint.spec
    camera, depth = spec.camera, spec.depth
    first, second, third = work_sizes(spec)
    numerator, denominator = tanh_polynomials()
    checkpoint_sha256 = checkpoint.config["weights"]["sha256"]
    export_sha256 = hashlib.sha256((checkpoint_sha256 + label).encode()).hexdigest()
    return {
        "NAME": name.replace("*/", "* /"),
        "VERSION": VERSION,
        "DTYPE": "int8" if layers else "float32",
        "WEIGHTS": sum(int(np.size(value)) for value in checkpoint.params.values()),
        "RATE": f"{spec.rate_hz:g}",
        "RATE_LITERAL": float_text(spec.rate_hz),
        "OBSERVATION": _observation(spec),
        "STATE_SIZE": spec.state_size,
        "ACTION": _ACTIONS[spec.action.kind].replace("$WHAT", spec.action.motors),
        "CONTRACT": contract_of(spec, (spec.hidden_size,)).digest,
        "ACTION_SIZE": spec.action.size,
        "HEIGHT": camera.height,
        "WIDTH": camera.width,
        "PITCH": float_text(camera.pitch_deg),
        "FOV_H": float_text(camera.fov_deg[0]),
        "FOV_V": float_text(camera.fov_deg[1]),
        "RAYS": camera.rays,
        "DEPTH_SCALE": float_text(depth.scale),
        "DEPTH_NEAR": float_text(depth.near),
        "DEPTH_FAR": float_text(camera.range_m),
        "DEPTH_OFFSET": float_text(depth.offset),
        "SHA256": checkpoint_sha256,
        # Equal in policy.h and policy.c, which do not compile with those of another export.
        "EXPORT": f"0x{export_sha256[:8]}",
        "JSON": _c_string(label),
        "MACS": multiply_adds(spec),
        "WEIGHT_BYTES": constant_bytes(checkpoint, layers),
        "FIRST": first,
        "SECOND": second,
        "EXTRA_STATE": f"    short bytes[{third}];\n" if layers else "",
        "HIDDEN_SIZE": spec.hidden_size,
        "PADDED": padded(spec.hidden_size),
        "GATES": padded(3 * spec.hidden_size),
        **{f"CHANNELS{k}": channels for k, channels in enumerate(spec.channels, 1)},
        "LEAK": float_text(LEAK),
        "TANH_P": _horner(numerator),
        "TANH_Q": _horner(denominator),
    }


def _observation(spec: PolicySpec) -> str:
    """Return the comment's lines on the parts of the state, with indices and units."""
    rows = [(3, *row) for row in _OBSERVATION]
    last = "the last flown action (SI units, limited), at first that of hover"
    rows.append((spec.action.size, last, "as the action"))
    rows += [(EXTRAS[key], *_EXTRA[key]) for key in EXTRAS if getattr(spec, key)]
    lines, index = [], 0
    for count, meaning, unit in rows:
        indices = f"{index}..{index + count - 1}" if count > 1 else str(index)
        lines.append(f" *     {indices}: {meaning} [{unit}]")
        index += count
    return "\n".join(lines)


def _c_string(text: str) -> str:
    """Return a text as C string literals, one a line; lines of a macro end in a backslash."""
    escaped = text.encode("ascii", "backslashreplace").decode().replace("\\", "\\\\")
    # Question marks are escaped: two of them can begin a trigraph of C99, which is replaced.
    escaped = escaped.replace('"', '\\"').replace("?", "\\?")
    pieces, piece = [], ""
    for word in escaped.split(" "):
        if len(piece) + len(word) > 88:
            pieces.append(piece)
            piece = ""
        piece += word + " "
    pieces.append(piece[:-1])
    return " \\\n".join(f'    "{piece}"' for piece in pieces)


def tanh_polynomials() -> tuple[list[float], list[float]]:
    """Return p and q, lowest power first, of tanh(x) = x p(x^2) / q(x^2).

    Lambert 1768: tanh x = x / (1 + x^2 / (3 + x^2 / (5 + ...))), cut after `TANH_TERMS` terms. The
    fraction is computed from the innermost term outwards. If v / p is the value of a term and
    s = x^2, the term outside it is (2k + 1) + s / (v / p) = ((2k + 1) v + s p) / v.
    """
    value, previous = [Fraction(2 * TANH_TERMS - 1)], [Fraction(1)]
    for k in range(TANH_TERMS - 2, -1, -1):
        shifted = [Fraction(0), *previous]
        size = max(len(value), len(shifted))
        padded_value = [*value, *[Fraction(0)] * (size - len(value))]
        shifted = [*shifted, *[Fraction(0)] * (size - len(shifted))]
        added = [(2 * k + 1) * v + s for v, s in zip(padded_value, shifted, strict=True)]
        value, previous = added, value
    return [float(p / value[0]) for p in previous], [float(q / value[0]) for q in value]


def _horner(coefficients: list[float]) -> str:
    """Return a polynomial in `s`, lowest power first, as a C expression (Horner's scheme)."""
    *lower, text = map(float_text, coefficients)
    for coefficient in reversed(lower):
        text = f"{coefficient} + s * ({text})"
    return text
