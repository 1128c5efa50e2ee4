"""The Kalman filter of the sensor model `gate_filter`, which estimates a drone's state."""
