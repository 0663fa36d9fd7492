"""A street built in numpy and OpenCV, with the truth known."""
