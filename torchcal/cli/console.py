"""Standard output and standard error, whose readers may go away before everything is said."""

import os

from rich.console import Console


class Speaker(Console):
    """A console that goes on in silence when nobody reads it any more, as before ``head``.

    What was asked for is done all the same, and the exit status says what became of it.
    """

    def on_broken_pipe(self) -> None:
        """Lets everything that is still said go nowhere, also what is buffered."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.file.fileno())
        os.close(nowhere)


def write(out: Console, text: str) -> None:
    """Writes text as it is, at once."""
    try:
        out.file.write(text)
        out.file.flush()
    except BrokenPipeError:
        out.on_broken_pipe()
