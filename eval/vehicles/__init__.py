"""The vehicle as data, and the vehicle files that are shipped."""
