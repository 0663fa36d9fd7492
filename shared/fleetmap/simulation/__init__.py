"""A street built in numpy and OpenCV, with the truth known.

``street.build_street`` -> ``driving.drive_along`` -> ``recording.record_drive`` (a file) or ``simulate_drive`` (in
memory); ``rendering`` says what any camera sees from any pose, and which point of the street is behind a pixel.
"""
