"""Export of a policy for other programs: writing, checking against the original, timing."""
