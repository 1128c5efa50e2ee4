"""Datagrams by UDP: `udpin:HOST:PORT` waits to be called, `udpout:HOST:PORT` calls."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable

MOST_BYTES = 2048
"""Of a datagram; a MAVLink message has 280 at most."""


class UdpLink:
    """One end of a link. One that waits answers whoever called first, and nobody else."""

    def __init__(self, address: str, speaks: Callable[[bytes], bool] = lambda _: True) -> None:
        """Open an end.

        Args:
            address: udpin:HOST:PORT or udpout:HOST:PORT.
            speaks: whether a datagram is a call; who sends another one does not take the link.

        Raises:
            ValueError: for an address of another form, a port that is taken, an unknown host.
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
        self._speaks = speaks
        self.strangers = 0
        """Datagrams of others, which were left out."""
        try:
            resolved = (socket.gethostbyname(host), int(port))
            if kind == "udpin":
                self._socket.bind(resolved)
        except OSError as error:
            self._socket.close()
            raise ValueError(
                f"--link {address}: {error.strerror or error}; udpin takes an address of this "
                "machine (0.0.0.0 for all) and a free port above 1023, udpout a host that is known"
            ) from None
        if kind == "udpout":
            self._peer = resolved

    @property
    def port(self) -> int:
        """The port that this end waits on."""
        return int(self._socket.getsockname()[1])

    def receive(self, wait_s: float = 0.0) -> list[bytes]:
        """Return the datagrams that have come, after at most `wait_s`; none where it is silent."""
        if wait_s > 0:
            select.select([self._socket], [], [], wait_s)
        found = []
        while True:
            try:
                data, sender = self._socket.recvfrom(MOST_BYTES)
            except BlockingIOError:
                return found
            except OSError:  # the other end is gone, and its machine said so
                continue
            if self._peer is None and self._speaks(data):
                self._peer = sender
            if sender == self._peer:
                found.append(data)
            else:
                self.strangers += 1

    def send(self, datagrams: list[bytes]) -> None:
        """Send datagrams; what nobody listens to, or the system has no room for, is lost."""
        if self._peer is None:
            return
        for datagram in datagrams:
            try:
                self._socket.sendto(datagram, self._peer)
            except OSError:
                continue

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()
