"""Sessions as rosbag2 folders of MCAP files: writing, streaming, recovery, metadata."""
