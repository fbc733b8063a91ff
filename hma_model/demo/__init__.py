"""Walk the whole road, small: `hma demo`."""
