"""Models from elsewhere in a process of their own, which can be killed."""
