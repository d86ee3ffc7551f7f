"""Where ``posematch`` starts: what it does is imported here, not before."""

from __future__ import annotations

import os
import signal


def main() -> None:
    """Run the command; Ctrl-C ends it quietly from the first moment on (130 in a shell).

    Where it is to be ignored, as in the background of a script, it stays so.
    """
    # The imports take a second: a traceback from amidst them would tell nobody anything.
    heard = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heard:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from app import cli

    if heard:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if os.getpid() == 1:  # in a container: the kernel drops the signals it does not handle
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    cli.main()
