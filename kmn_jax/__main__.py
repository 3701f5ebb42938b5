"""Start the `kmn` command: an interrupt while its libraries are being loaded ends it, too, without a traceback."""

import sys


def main() -> int:
    """Run the command line, see `kmn_jax.cli.main`."""
    try:
        from kmn_jax.cli import main as run

        return run()
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
