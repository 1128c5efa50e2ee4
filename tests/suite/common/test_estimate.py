"""What is said before long work."""

from suite.common.console import Console
from suite.common.stages import Estimate, announce


def test_an_estimate_is_said_and_missing_memory_is_warned_of(capsys):
    announce(Console(), "training", Estimate(seconds=130, memory_bytes=2e9))
    assert capsys.readouterr().err == "training: about 2 min 10 s and 2.0 GB of memory\n"
    announce(Console(), "training", Estimate(seconds=1, memory_bytes=1e18))
    assert "warning" in capsys.readouterr().err
