"""The error for input that jaxfit cannot use."""

__all__ = ["InputError"]


class InputError(ValueError):
    """A file or an argument that jaxfit cannot use.

    The message names the file, the field and the remedy; the command line prints it without a traceback
    and exits with code 2.
    """

    def __init__(self, source: object, problem: str, remedy: str = ""):
        self.source, self.problem, self.remedy = str(source), problem, remedy
        super().__init__(f"{self.source}: {problem}" + (f" ({remedy})" if remedy else ""))
