"""Share what the formats need alike: survey of episodes, checks of pictures and times, video files."""
