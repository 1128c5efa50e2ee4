"""What has changed since reference flights of the same vehicle: their means, and how it moves."""
