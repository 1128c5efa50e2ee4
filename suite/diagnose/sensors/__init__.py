"""Models of sensors and estimators from flights with a reference."""
