"""Errors of worker processes. Light to import: the command line handles them."""


class WorkerError(Exception):
    """A worker process failed; its cause holds the worker's traceback."""


class WorkerLostError(WorkerError):
    """A worker process ended, and its environments with it."""
