"""The scene in the frame of the robot, and the clocks of log and videos."""
