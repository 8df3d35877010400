"""Errors of worker processes, and of copies. Light to import: the command line handles them."""

from symsteer.errors import UserError


class WorkerError(Exception):
    """A worker process failed; a note holds its traceback."""


class WorkerLostError(WorkerError):
    """A worker process ended, and its environments with it."""


class Unique:
    """Cannot be copied or pickled: its simulation is in one process."""

    def __reduce_ex__(self, protocol: object) -> str:
        cure = "make another one, and give it the state: set_state_dict(env.get_state_dict())"
        raise UserError(f"an environment cannot be copied or pickled; {cure}")
