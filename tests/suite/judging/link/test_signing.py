"""Messages that are signed: forged, unsigned and repeated ones are left out."""

from pathlib import Path

import numpy as np
import pytest

from suite.judging.link.messages import OperatorText, SetPoint, Wire, signing_key
from tests.support.commands import refused

pytest.importorskip("pymavlink", reason="pymavlink is not installed (the extra mavlink)")

POINT = SetPoint(np.array([0.5, -0.25, 2.0]), 0.375)


@pytest.fixture
def key(tmp_path):
    (tmp_path / "phrase").write_text("correct horse\n")
    return signing_key(tmp_path / "phrase")


def test_what_is_signed_is_heard_once_and_what_is_not_or_by_another_is_left_out(key):
    vehicle, companion = Wire(1, 2, key), Wire(2, 1, key)
    sent = companion.encode(POINT)
    assert vehicle.is_from_peer(sent) and vehicle.is_from_peer(sent), "to look is not to take"
    assert len(vehicle.decode([sent])) == 1 and vehicle.broken == 0
    assert vehicle.decode([sent]) == [] and vehicle.broken == 1, "sent again by someone else"
    assert vehicle.decode([companion.encode(OperatorText("a"))]) == [OperatorText("a")]
    vehicle, companion = Wire(1, 2, key), Wire(2, 1, key)
    first = companion.encode(POINT)
    forged = bytearray(companion.encode(OperatorText("b")))
    forged[-8:-6] = b"\xff\xff"  # of a later time, so that no true one would be later
    for odd in (Wire(2, 1).encode(POINT), Wire(2, 1, bytes(32)).encode(POINT), bytes(forged)):
        assert vehicle.decode([odd]) == [] and not vehicle.is_from_peer(odd)
    assert vehicle.broken == 3 and len(vehicle.decode([first])) == 1
    sent = Wire(2, 1).encode(POINT)
    assert sent[2] == 0, "no flag of a signature"
    assert len(Wire(1, 2).decode([sent])) == 1 == len(Wire(1, 2).decode([sent]))


def test_a_key_is_of_a_file_with_a_phrase_and_of_a_real_link(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert signing_key(None) is None
    (tmp_path / "empty").touch()
    with pytest.raises(ValueError, match="write the passphrase"):
        signing_key(tmp_path / "empty")
    with pytest.raises(ValueError, match="cannot be read"):
        signing_key(Path("nowhere"))
    assert "--signing-key needs --link" in refused(capsys, "fly --signing-key empty")
