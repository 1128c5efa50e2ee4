"""The subcommands of `suite`, one file each, imported when called."""
