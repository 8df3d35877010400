"""Detectors of broken symmetry, scored against the audit."""
