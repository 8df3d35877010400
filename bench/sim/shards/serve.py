"""Entry point of a worker process, light to import: the user's process names it, no more."""

from __future__ import annotations

import signal
from multiprocessing.connection import Connection

from symsteer.bench.sim.shards.block import SharedBlock


def serve(connection: Connection, inbox: SharedBlock, outbox: SharedBlock) -> None:
    """Make environments and answer requests until the other side hangs up."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from symsteer.bench.sim.shards.worker import Worker

    Worker(connection, inbox, outbox).run()
