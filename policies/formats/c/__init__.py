"""The suite's policies as C99 source: written, quantised, compiled and loaded."""
