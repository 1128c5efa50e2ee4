"""Who works, as it is asked for; what goes to another machine, and what must be the same there."""

import copy

import pytest

from suite.common.errors import explain
from tracks.common.work import MOST, core_shares, crew, read_workers
from tracks.common.work.threads import usable_cores
from tracks.common.work.travel import PACKAGES, differences, failure, pack, raised, software, unpack


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
    ["0", "-1", "two", "", "1.5", str(MOST + 1), "9" * 5000, "tcp://head", "ftp://a:1", "::"],
)
def test_others_are_refused_with_what_is_allowed(text):
    with pytest.raises(ValueError, match=r"^--workers is '.{0,80}'; allowed is 1 to 256.*tcp://"):
        read_workers(text)


def test_a_number_is_its_own_crew_and_shares_no_core():
    assert crew(3) == 3
    assert len(core_shares(1)[0]) == usable_cores()


def test_the_software_is_told_apart_by_name():
    ours = software()
    assert set(PACKAGES) < set(ours) and differences(copy.copy(ours), ours) == ""
    assert differences({**ours, "jax": "0.1"}, ours) == f"jax 0.1 there, {ours['jax']} here"


class Stubborn(Exception):
    def __reduce__(self):
        raise TypeError("cannot be pickled")


def test_an_error_travels_with_where_it_came_up():
    from eval.effects import find_effect

    with pytest.raises(ValueError) as caught:
        find_effect("linear_dragg")
    there = unpack(pack(failure(caught.value)))
    elsewhere = there._replace(
        root="/opt/suite", lines=there.lines.replace(there.root, "/opt/suite")
    )
    found = raised(elsewhere)
    assert explain(found) == (2, str(found)) and "linear_drag" in str(found)
    assert str(raised(failure(Stubborn("so")))) == "Stubborn: so"
