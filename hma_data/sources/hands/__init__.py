"""Read videos of human hands: where both hands are in the image stands for the action."""

from hma_data.sources.base import Recognition

VIDEO_SUFFIXES = (
    ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".mts", ".ogv", ".flv", ".gif",
)  # fmt: skip
RECOGNITION = Recognition(label="videos of hands", weak_endings=VIDEO_SUFFIXES)
