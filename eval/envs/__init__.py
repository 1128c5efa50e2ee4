"""The judge's quadrotor and tracks as environments of dm_control and gymnasium."""
