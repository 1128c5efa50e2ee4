"""What randomisation buys: the recipe, without each of its spreads, and without any, in pairs."""

import pytest

from tests.support.documents import page, reproduce

ARGS = ["randomisation", "--only", "thrust_scale", "--trials", "2", "--difficulty", "0"]


@pytest.mark.slow
def test_all_settings_of_every_seed_fly_the_same_share(sky, made, tmp_path):
    args = [
        *ARGS,
        "--training-seeds",
        "3",
        "5",
        "--iterations",
        "7",
        "--without",
        "thrust",
        "thrust",
    ]
    assert reproduce(tmp_path, *args) == 0
    drawn = [(c.seed, c.quadrotor.thrust_spread, c.quadrotor.mass_std) for c in made]
    assert drawn == [
        (3, 0, 0), (5, 0, 0), (3, 0, 0.08), (5, 0, 0.08), (3, 0.1, 0.08), (5, 0.1, 0.08),
    ]  # fmt: skip
    assert {c.optimizer.iterations for c in made} == {7}
    # Undisturbed, less and more thrust; three tracks, two seeds, three settings.
    assert len(sky.flown) == (1 + 2) * 3 * 2 * 3
    text, numbers = page(tmp_path, "randomisation")
    assert list(numbers["worth"]) == ["fixed", "without thrust"]
    assert list(numbers["worth"]["without thrust"]) == [
        "undisturbed",
        "its own",
        "all disturbances",
    ]
    assert "- recipe: swift-quad from swift, 7 gradient steps" in text
    assert "| thrust | thrust_scale | +0 [+0, +0] (+0 +0) | +0" in text
    assert "| randomised | 0, 0 | 0, 0 |" in text
    assert reproduce(tmp_path, *args) == 0
    assert len(made) == 6 and len(sky.flown) == 54, "the second time all is there"
    assert reproduce(tmp_path, *args, "--from", "swift-quad") == 0
    assert len(made) == 12, "from another policy all is trained anew"


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--only", "linear_dra"], "linear_drag"),
        (["--without", "winds"], "Did you mean 'wind'?"),
        (["--preset", "swift", "--without", "mass"], "unknown spread 'mass'"),
        (["--training-seeds", "1", "1"], "--training-seeds is 1 1"),
        (["--iterations", "0"], "--iterations is 0"),
        (["--workers", "99"], "--workers is 99"),
        (
            ["--training-seeds", *"0123456"],
            "6 on all tracks and levels, and they are shared among 7",
        ),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_trained(
    args, words, made, tmp_path, capsys
):
    begun = ["randomisation"] if "--only" in args else ARGS
    assert reproduce(tmp_path, *begun, *args) == 2
    assert words in capsys.readouterr().err
    assert not made and not list(tmp_path.iterdir())
