"""Diagnosis: finds which physical effect a simulation lacks, from flights that differ from it."""
