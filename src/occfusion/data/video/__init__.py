"""One's own footage, in the form that PeopleSnapshot and NeuMan have come to."""

from occfusion.data.video.video_data import VideoDataModule

__all__ = ["VideoDataModule"]
