"""A UDP socket as one end of the link between the vehicle and the policy's computer.

An end with the address `udpin:HOST:PORT` waits for the other end; one with `udpout:HOST:PORT` sends
first.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Callable

MOST_BYTES = 2048
"""Largest number of bytes of a datagram; a MAVLink message has at most 280."""


class UdpLink:
    """One end of a link; a waiting end exchanges datagrams only with the first valid sender."""

    def __init__(
        self, address: str, is_from_peer: Callable[[bytes], bool] = lambda _: True
    ) -> None:
        """Open an end at `address`, which is udpin:HOST:PORT or udpout:HOST:PORT.

        A waiting end ignores all datagrams before the first that `is_from_peer`.

        Raises:
            ValueError: for an address of another form, a port in use, or an unknown host.
        """
        kind, _, place = address.partition(":")
        host, _, port = place.rpartition(":")
        if kind not in ("udpin", "udpout") or not host or not port.isdecimal():
            raise ValueError(
                f"--link {address}: allowed are udpin:HOST:PORT (wait to be called) and "
                "udpout:HOST:PORT (call); for a serial port run mavlink-router on the same computer"
            )
        if int(port) > 65535:
            raise ValueError(f"--link {address}: the port must be 0 to 65535")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peer: tuple[str, int] | None = None
        self._is_from_peer = is_from_peer
        self.strangers = 0
        """Number of ignored datagrams of other senders."""
        try:
            resolved = (socket.gethostbyname(host), int(port))
            if kind == "udpin":
                self._socket.bind(resolved)
        except OSError as error:
            self._socket.close()
            raise ValueError(
                f"--link {address}: {error.strerror or error}; udpin needs an address of this "
                "machine (0.0.0.0 for all) and a free port above 1023, udpout a host that can be "
                "found"
            ) from None
        if kind == "udpout":
            self._peer = resolved

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    def receive(self, wait_s: float = 0.0) -> list[bytes]:
        """Return the received datagrams, after waiting for at most `wait_s`; may be none."""
        if wait_s > 0:
            select.select([self._socket], [], [], wait_s)
        received = []
        while True:
            try:
                data, sender = self._socket.recvfrom(MOST_BYTES)
            except OSError:  # no further datagram, or the other end is closed
                return received
            if self._peer is None and self._is_from_peer(data):
                self._peer = sender
            if sender == self._peer:
                received.append(data)
            else:
                self.strangers += 1

    def send(self, datagrams: list[bytes]) -> None:
        """Send datagrams; errors are ignored, as UDP may lose datagrams anyway."""
        if self._peer is None:
            return
        for datagram in datagrams:
            try:
                self._socket.sendto(datagram, self._peer)
            except OSError:
                continue

    def close(self) -> None:
        """Release the port."""
        self._socket.close()
