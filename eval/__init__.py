"""The judge: the MuJoCo quadrotor, worlds, trials, flight logs, tables and recordings."""
