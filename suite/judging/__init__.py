"""The work of the commands that fly, check or export a policy."""
