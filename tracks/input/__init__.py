"""What comes from people and from elsewhere: ranges of settings, and files read with care."""
