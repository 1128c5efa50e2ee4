"""Sources of evidence: what each fits and holds out, and how what is found in it is judged."""
