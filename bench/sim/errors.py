"""What can go wrong with worker processes; light to import."""


class WorkerError(Exception):
    """A worker process failed; its cause holds the worker's own traceback."""


class WorkerLostError(WorkerError):
    """A worker process ended, and its environments with it."""
