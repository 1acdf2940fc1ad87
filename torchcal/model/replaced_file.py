"""Files that are written as a whole or not at all."""

import secrets
from pathlib import Path


def replace_file(file: Path, content: bytes) -> None:
    """Writes a file; until all of it is written, an earlier one stays as it was."""
    partial = file.with_name(f".{file.stem}.partial-{secrets.token_hex(4)}{file.suffix}")
    try:
        partial.write_bytes(content)
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)
