"""A study: settings x training seeds, trained, flown in unseen worlds or judged, and compared."""
