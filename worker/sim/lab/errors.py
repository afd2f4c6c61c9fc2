"""What is wrong with a laboratory's environment, policy or functions, in a sentence that says what to do."""


class LabTaskBroken(ValueError):
    """What a lab.toml names does not do what it must; the message says which key, what happened and what to do."""

    def __init__(self, key: str, what: str) -> None:
        super().__init__(f"{key}: {what}")
        self.key, self.what = key, what

    def __reduce__(self) -> tuple[type["LabTaskBroken"], tuple[str, str]]:
        """Comes whole out of a compute process."""
        return type(self), (self.key, self.what)
