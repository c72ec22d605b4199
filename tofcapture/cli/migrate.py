"""``tofcapture migrate``: rewrite shards of an earlier version of the format."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tofcapture.command import Command, Outcome
from tofcapture.errors import ConfigError


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", type=Path, metavar="PATH", help="shard or dataset")


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.files.migrate import migrate

    path: Path = args.path
    if not path.exists():
        raise ConfigError(
            f"{path}: expected a shard or a dataset, found nothing there", hint="tofcapture migrate PATH"
        )
    done = migrate(path, lambda shard: print(f"migrate {shard}", file=sys.stderr, flush=True))
    changed = sum(m.changed for m in done)
    rows = [{"path": str(m.path), "before": m.before, "changed": m.changed, "sha256": m.sha256} for m in done]
    text = f"{path}: {changed} of {len(done)} shards rewritten"
    return Outcome({"path": str(path), "changed": changed, "shards": rows}, text)


COMMAND = Command(
    help="rewrite shards of an earlier version of the format as the present one",
    example="tofcapture migrate datasets/first",
    configure=_configure,
    run=_run,
)
