"""One file a format: `read(path, options) -> Recording`."""
