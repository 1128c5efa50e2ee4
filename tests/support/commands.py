"""Commands in the test's own process: their answers, and the lines by which they refuse."""

import json

from suite import cli


def run(line, *words):
    """Run a command line, and further words that are not split; return the exit code."""
    return cli.main([*line.split(), *map(str, words)])


def answer(capture, line, *words):
    """Return what a command answers under --json; `capture` is capsys or capfd."""
    capture.readouterr()
    assert run(line, *words, "--json") == 0
    return json.loads(capture.readouterr().out)


def refused(capture, line, *words, lines=1):
    """Return the message of so many lines with which a command refuses its input (code 2)."""
    capture.readouterr()
    assert run(line, *words) == 2
    said = capture.readouterr().err
    message = said.splitlines()[-lines:]
    assert message[0].startswith("suite: ") and said.count("suite: ") == 1, said
    assert len("".join(message)) < 1000, said
    return " ".join(said.split())


def evaluate(out, line, *words):
    """Run `suite eval` into `out`, by default at level 0 for 0.1 s; return the exit code."""
    level = "" if "--difficulty" in line else "--difficulty 0"
    limit = "" if "--time-limit-s" in line else "--time-limit-s 0.1"
    return run(f"eval {level} {limit} {line}", *words, "--out", out)
