"""Test cases with hidden effects: made from seeds, diagnosed without their answers, scored."""
