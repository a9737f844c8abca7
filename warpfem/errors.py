"""The exceptions of warpfem. Each message says what is wrong, where, and what to try."""


class WarpfemError(Exception):
    """Base of every error that warpfem raises on purpose."""


class MeshError(WarpfemError, ValueError):
    """A mesh that cannot be simulated: names the first offending index and how many there are."""


class MaterialError(WarpfemError, ValueError):
    """Material parameters outside the domain of the material."""


class SceneError(WarpfemError, ValueError):
    """A scene that contradicts itself or refers to something that does not exist."""


class OutputError(WarpfemError, OSError):
    """An output file that cannot be written, or read back."""


class MissingExtraError(WarpfemError, ImportError):
    """An optional dependency is not installed: the message names the extra to install."""

    def __init__(self, purpose: str, package: str, extra: str) -> None:
        super().__init__(f"{purpose} needs the package '{package}': pip install 'warpfem[{extra}]'")
        self.package = package
        self.extra = extra


class SimulationError(WarpfemError, RuntimeError):
    """A run that cannot go on: it diverged, or a step could not be solved."""
