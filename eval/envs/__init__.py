"""The judge's quadrotor and tracks as environments of dm_control and gymnasium."""

ID = "diffracing/Race-v0"
"""Of gymnasium's registry, in which `register` puts it as gymnasium is imported."""


def register() -> None:
    """Register `ID`, for `gymnasium.make` and `gymnasium.make_vec`: an entry point of gymnasium."""
    import gymnasium

    if ID not in gymnasium.registry:
        gymnasium.register(
            id=ID,
            entry_point="eval.envs.gymnasium_env:RaceEnv",
            vector_entry_point="eval.envs.gymnasium_env:RaceVectorEnv",
        )
