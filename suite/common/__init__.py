"""What commands share: console, errors, reports, charts, work."""
