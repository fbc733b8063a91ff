"""Read bags: ROS 1, ROS 2 sqlite3 and MCAP files, and the messages in them."""
