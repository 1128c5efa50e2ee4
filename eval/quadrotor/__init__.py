"""The quadrotor: controllers, mixer, rotors and body, with every effect of the vehicle."""
