"""The quadrotor's dynamics: controllers, mixer, rotors and body, with all effects of a vehicle."""
