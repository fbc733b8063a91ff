"""Read bags: ROS 1, ROS 2 sqlite3 and MCAP files, and the messages in them."""

from hma_data.sources.base import Recognition

RECOGNITION = Recognition(
    label="a ROS bag or MCAP",
    endings=(".bag", ".mcap", ".db3", ".mcap.zstd", ".db3.zstd"),
    magic=(b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3", b"rosbag2_bagfile_information:"),
)
