"""The subcommands of `kornia-tidy`, one to a file: add_parser() describes it, run() does it."""
