"""Progress and figures for people."""

from suite.common.console import Console, duration, size


def test_progress_without_a_terminal_is_a_plain_line_now_and_then(capsys):
    now = [0.0]
    with Console().progress("flying", 100, clock=lambda: now[0]) as update:
        for done in range(101):
            now[0] = done * 0.5
            update(done, "3.1 m/s")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    assert lines[0] == "flying: 20 of 100, 40 s left, 3.1 m/s"


def test_the_time_left_counts_only_what_was_done_since_it_began(capsys):
    now = [0.0]
    with Console().progress("training", 100, clock=lambda: now[0], begun=80) as update:
        now[0] = 12.0
        update(90)
    assert capsys.readouterr().err == "training: 90 of 100, 12 s left\n"


def test_figures_for_people():
    assert [duration(s) for s in (0.44, 9.96, 59.6, 200, 7500)] == [
        "0.4 s",
        "10 s",
        "1 min 00 s",
        "3 min 20 s",
        "2 h 05 min",
    ]
    assert [size(b) for b in (5, 812e3, 2.06e9)] == ["5 B", "812 kB", "2.1 GB"]
