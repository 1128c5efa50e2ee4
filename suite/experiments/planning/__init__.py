"""The fastest lap that is found with everything known: planned, and flown in MuJoCo."""
