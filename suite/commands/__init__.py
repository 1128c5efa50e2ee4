"""The commands of `suite`, one module each, imported when the command is called."""
