"""Where ``posematch`` starts: what it does is imported here, not before."""

from __future__ import annotations

import signal


def main() -> None:
    """Run the command; Ctrl-C ends it quietly from the first moment on (130 in a shell)."""
    # The imports take a second: a traceback from amidst them would tell nobody anything.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from app import cli

    signal.signal(signal.SIGINT, signal.default_int_handler)
    cli.main()
