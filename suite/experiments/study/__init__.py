"""Studies: policies of several settings and training seeds are trained, judged and compared."""
