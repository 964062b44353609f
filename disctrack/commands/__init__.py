"""One module per subcommand, with `run(arguments) -> exit code` (or nothing: DONE); what it may be given: `options`."""

DONE = 0
FAILED = 1  # nothing was written; the reason is on stderr
USAGE = 2  # argparse's own
INCOMPLETE = 3  # the result is written, but some of the input could not be read
INTERNAL = 70
