"""The vehicle as a dataclass, its physical checks, and the vehicle files that the suite ships."""
