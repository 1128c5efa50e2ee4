"""Convert between the link's messages (MAVLink 2, dialect `common`) and values in our frames.

| content | message |
|---|---|
| state of the vehicle | ODOMETRY (331): LOCAL_NED, velocity there or in BODY_FRD |
| depth image | DATA_TRANSMISSION_HANDSHAKE (130) and ENCAPSULATED_DATA (131): a 16-bit PGM in mm |
| body rates and thrust | SET_ATTITUDE_TARGET (82), attitude ignored, thrust 0 to 1 |
| text for the operator | STATUSTEXT (253) |
| heartbeat of the companion | HEARTBEAT (0) |

MAVLink has no message for depth images (OBSTACLE_DISTANCE has 72 distances in a plane). So they are
sent with its transmission of small images, in packets: 24 x 32 pixels need seven. If a packet is
lost, only its image is lost.

The world frame of MAVLink is NED (north, east, down) and its body frame is FRD (forward, right,
down). Those of the suite are z up and FLU (forward, left, up). Both conversions are the same half
turn about x.
"""

from __future__ import annotations

import copy
import hashlib
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.importers.frames import HALF_TURN, QUAT_HALF_TURN
from suite.common.errors import WorkFailed
from tracks.geometry.rotation import quat_to_rot, to_local, to_world
from tracks.input.reading import read_bytes, reason

PACKET = 253
"""Number of bytes of an image in one message."""
MOST_PACKETS = 65535
"""Largest number of packets of an image."""
IGNORE_ATTITUDE = 128
"""Bit in the type mask of SET_ATTITUDE_TARGET: only rates and thrust are commanded."""
SIGNING_EPOCH_S = 1420070400
"""Beginning of 2015, the epoch of MAVLink's signatures [s]."""
LOCAL_NED, BODY_FRD = 1, 12
"""Numbers of the two frames in MAVLink."""
_HEAD = b"P5\n%d %d\n65535\n"
"""Header of a 16-bit PGM image: width and height."""


class State(NamedTuple):
    """The vehicle's measured state; arrays in the frames of the suite."""

    time_s: float
    """Time of the measurement on the vehicle's clock [s]."""
    pos_w: np.ndarray
    """(3,) position [m]."""
    quat_wxyz: np.ndarray
    """(4,) attitude, body to world."""
    vel_w: np.ndarray
    """(3,) velocity [m/s]."""
    rate_b: np.ndarray
    """(3,) body rates [rad/s]."""
    resets: int = 0
    """How often the vehicle's state estimator has reset its estimate, which then jumps."""
    fault: str = ""
    """Reason for which the message cannot be used, or ""."""
    component: int = 1
    """Number of the MAVLink component that sent it."""


class SetPoint(NamedTuple):
    """Commands for the vehicle until the next set point."""

    rate_b: np.ndarray
    """(3,) wanted body rates [rad/s]."""
    thrust: float
    """Share of the largest collective thrust, 0 to 1."""


class OperatorText(NamedTuple):
    """A text for the operator."""

    text: str


class Heartbeat(NamedTuple):
    """A heartbeat of the companion, from which a waiting vehicle gets its address."""


class Packet(NamedTuple):
    """A packet of an image, or the announcement before the packets of an image."""

    number: int
    """Number of the packet, from 0; -1 for an announcement."""
    total: int
    """Number of packets of the image in an announcement, else 0."""
    data: bytes
    """Bytes of the image. In an announcement: width, height [pixel] and size [byte] of the image as
    three uint32."""


Message = State | SetPoint | OperatorText | Heartbeat | Packet


def dialect() -> Any:
    """Return the module of pymavlink with the messages of the dialect `common`.

    Raises:
        WorkFailed: if pymavlink is not installed.
    """
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        raise WorkFailed(
            "MAVLink needs the package pymavlink: pip install 'diffracing-suite[mavlink]'"
        ) from error
    return common


def signing_key(path: Path | None) -> bytes | None:
    """Return the key (32 bytes) from a file with a passphrase, as in ground stations.

    Without a file return None.

    Raises:
        ValueError: if the file cannot be read or is empty.
    """
    if path is None:
        return None
    try:
        phrase = read_bytes(path, 4096).strip()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {reason(error)}") from None
    if not phrase:
        raise ValueError(f"{path}: is empty; write the passphrase of the link into it")
    return hashlib.sha256(phrase).digest()


class Wire:
    """One end of a link: converts messages of this module to datagrams and back.

    Messages of other systems (`foreign`) and damaged ones (`broken`) are counted and left out.
    """

    def __init__(self, own: int, other: int, key: bytes | None = None) -> None:
        """Make an end of a link, from its own MAVLink system number and that of the other end.

        The 32 bytes of `key` sign the messages (MAVLink 2); None: no signatures. With a key,
        received messages that are unsigned or repeated count as broken.
        """
        self._dialect = dialect()
        self._out = self._dialect.MAVLink(None, srcSystem=own, srcComponent=1)
        self._signing = self._dialect.MAVLink(None).signing
        for signing in (self._out.signing, self._signing) if key else ():
            signing.secret_key, signing.sign_outgoing = key, True
            signing.timestamp = int((time.time() - SIGNING_EPOCH_S) * 1e5)
        self._own, self._other = own, other
        self.foreign = 0
        self.broken = 0

    def encode(self, message: Message) -> bytes:
        """Return a message as one datagram."""
        mav = self._out
        if isinstance(message, State):
            quat = flip_quat(message.quat_wxyz)
            vel = flip_axes(to_local(quat_to_rot(message.quat_wxyz), message.vel_w))
            packed = mav.odometry_encode(
                int(message.time_s * 1e6), LOCAL_NED, BODY_FRD, *flip_axes(message.pos_w),
                quat.tolist(), *vel, *flip_axes(message.rate_b), [0.0] * 21, [0.0] * 21,
                message.resets,
            )  # fmt: skip
        elif isinstance(message, SetPoint):
            packed = mav.set_attitude_target_encode(
                0, self._other, 1, IGNORE_ATTITUDE, [1.0, 0.0, 0.0, 0.0],
                *flip_axes(message.rate_b), message.thrust,
            )  # fmt: skip
        elif isinstance(message, OperatorText):
            packed = mav.statustext_encode(4, message.text.encode("ascii", "replace")[:50])
        elif isinstance(message, Heartbeat):
            kind = self._dialect.MAV_TYPE_ONBOARD_CONTROLLER
            none, active = self._dialect.MAV_AUTOPILOT_INVALID, self._dialect.MAV_STATE_ACTIVE
            packed = mav.heartbeat_encode(kind, none, 0, 0, active)
        elif message.number < 0:
            width, height, size = np.frombuffer(message.data, np.uint32)
            kind = self._dialect.MAVLINK_DATA_STREAM_IMG_PGM
            numbers = (int(size), int(width), int(height), message.total)
            packed = mav.data_transmission_handshake_encode(kind, *numbers, PACKET, 0)
        else:
            data = message.data.ljust(PACKET, b"\0")
            packed = mav.encapsulated_data_encode(message.number, list(data))
        return packed.pack(mav)

    def is_from_peer(self, datagram: bytes) -> bool:
        """Return whether a datagram comes from the other end."""
        messages, _ = self._parse(datagram, keep=False)
        return any(
            message.get_type() != "BAD_DATA" and message.get_srcSystem() == self._other
            for message in messages
        )

    def decode(self, datagrams: Iterable[bytes]) -> list[Message]:
        """Return the received messages in order."""
        decoded: list[Message] = []
        for datagram in datagrams:
            messages, is_truncated = self._parse(datagram)
            self.broken += is_truncated
            for message in messages:
                if message.get_type() == "BAD_DATA":
                    self.broken += 1
                elif message.get_srcSystem() != self._other:
                    self.foreign += 1
                else:
                    with np.errstate(invalid="ignore"):  # the watchdog checks for infinities
                        decoded += self._convert(message)
        return decoded

    def _parse(self, datagram: bytes, keep: bool = True) -> tuple[list[Any], bool]:
        """Return the MAVLink messages in a datagram, and whether the datagram is truncated.

        With `keep` the time stamps of its signatures are remembered, to detect repeated messages.
        """
        # Each datagram has a new parser: a truncated message must not affect the next datagram.
        parser = self._dialect.MAVLink(None)
        parser.robust_parsing = True
        parser.signing = copy.deepcopy(self._signing)
        messages = parser.parse_buffer(datagram) or []
        if keep and not any(message.get_type() == "BAD_DATA" for message in messages):
            # Only time stamps of valid signatures are kept; a forged message must not change them.
            self._signing = parser.signing
        return messages, parser.buf_len() > 0

    def _convert(self, message: Any) -> list[Message]:
        """Return a MAVLink message as one of this module; an empty list if its type is not used."""
        message_type = message.get_type()
        if message_type == "ODOMETRY":
            return [_state_of(message)]
        if message_type == "SET_ATTITUDE_TARGET":
            if message.target_system != self._own:
                self.foreign += 1
                return []
            rates = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
            return [SetPoint(flip_axes(rates), float(message.thrust))]
        if message_type == "STATUSTEXT":
            return [OperatorText(message.text)]
        if message_type == "DATA_TRANSMISSION_HANDSHAKE":
            sizes = np.array([message.width, message.height, message.size], np.uint32)
            return [Packet(-1, message.packets, sizes.tobytes())]
        if message_type == "ENCAPSULATED_DATA":
            return [Packet(message.seqnr, 0, bytes(message.data))]
        return []


def _state_of(message: Any) -> State:
    """Return the state in an ODOMETRY message, in the frames of the suite.

    Autopilots differ in the frame of the velocity. PX4 sends LOCAL_NED since version 1.14, and
    BODY_FRD in earlier versions.
    """
    quat = flip_quat(message.q)
    norm = float(np.linalg.norm(quat))
    quat = quat / norm if np.isfinite(norm) and norm > 0.5 else np.full(4, np.nan)
    vel = flip_axes([message.vx, message.vy, message.vz])
    fault = ""
    if message.frame_id != LOCAL_NED or message.child_frame_id not in (LOCAL_NED, BODY_FRD):
        fault = (
            f"ODOMETRY in frames {message.frame_id} and {message.child_frame_id}, allowed are "
            f"{LOCAL_NED} (LOCAL_NED), and {LOCAL_NED} or {BODY_FRD} (BODY_FRD) of the velocity"
        )
    elif message.quality < 0:
        fault = "the vehicle's estimator has failed (ODOMETRY's quality is negative)"
    return State(
        time_s=message.time_usec * 1e-6,
        pos_w=flip_axes([message.x, message.y, message.z]),
        quat_wxyz=quat,
        vel_w=to_world(quat_to_rot(quat), vel) if message.child_frame_id == BODY_FRD else vel,
        rate_b=flip_axes((message.rollspeed, message.pitchspeed, message.yawspeed)),
        resets=message.reset_counter,
        fault=fault,
        component=message.get_srcComponent(),
    )


def image_packets(depth_m: np.ndarray, range_m: float) -> list[Packet]:
    """Return a planar depth image (H, W) [m] as packets, the announcement first.

    Depths of `range_m` and more become 0, "no depth".
    """
    height, width = depth_m.shape
    millimetres = np.where(depth_m < range_m, np.rint(depth_m * 1e3), 0).clip(0, 65535)
    data = _HEAD % (width, height) + millimetres.astype(">u2").tobytes()
    parts = [data[k : k + PACKET] for k in range(0, len(data), PACKET)]
    sizes = np.array([width, height, len(data)], np.uint32)
    first = Packet(-1, len(parts), sizes.tobytes())
    return [first, *(Packet(k, 0, part) for k, part in enumerate(parts))]


class ImageAssembler:
    """Assembles depth images from received packets."""

    def __init__(self, height: int, width: int, range_m: float) -> None:
        """Assemble images of this size; pixels without depth get `range_m`.

        Raises:
            ValueError: for images with more packets than MAVLink can number.
        """
        self._shape, self._range_m = (height, width), range_m
        self._head = _HEAD % (width, height)
        self._size = len(self._head) + 2 * height * width
        if self._size > MOST_PACKETS * PACKET:
            raise ValueError(
                f"a camera of {height} x {width} pixels: the link carries images of at most "
                f"{MOST_PACKETS * PACKET // 2} pixels; fly a policy with a smaller one"
            )
        self._received: dict[int, bytes] = {}
        self._expected = 0
        self.other_size: tuple[int, int] | None = None
        """Width and height of the last announced image of another size."""

    def add(self, packet: Packet) -> np.ndarray | None:
        """Return the depth image (H, W) [m] that this packet completes, else None."""
        if packet.number < 0:
            width, height, size = (int(x) for x in np.frombuffer(packet.data, np.uint32))
            # The right number of packets: a division that rounds up.
            fits = size == self._size and packet.total == -(-self._size // PACKET)
            self._received, self._expected = {}, packet.total if fits else 0
            if (height, width) != self._shape:
                self.other_size = (width, height)
            return None
        # A received number with other bytes is of the next image, whose announcement was lost; with
        # the same bytes the network has doubled the packet.
        if self._received.get(packet.number, packet.data) != packet.data:
            self._received, self._expected = {}, 0
        if packet.number >= self._expected:
            return None
        self._received[packet.number] = packet.data
        if len(self._received) < self._expected:
            return None
        data = b"".join(self._received[k] for k in range(self._expected))[: self._size]
        self._received, self._expected = {}, 0
        if not data.startswith(self._head):
            return None
        millimetres = np.frombuffer(data, ">u2", offset=len(self._head)).reshape(self._shape)
        metres = np.where(millimetres == 0, self._range_m, millimetres * 1e-3)
        return np.minimum(metres, self._range_m)


def flip_axes(vector: Sequence[float] | np.ndarray) -> np.ndarray:
    """Convert a vector (3,) from NED or FRD to z up or FLU, or back."""
    return np.asarray(vector, float) * HALF_TURN


def flip_quat(quat_wxyz: Sequence[float] | np.ndarray) -> np.ndarray:
    """Convert an attitude (4,), body to world, from FRD to NED to FLU to z up, or back."""
    return np.asarray(quat_wxyz, float) * QUAT_HALF_TURN
