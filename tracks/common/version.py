"""The suite's version, in one place: the build reads it, and every file we write carries it."""

VERSION = "0.1.0"
