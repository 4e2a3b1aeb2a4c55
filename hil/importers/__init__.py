"""Import of recordings of other programs: logs of numbers (text, arrays) and rosbag2."""
