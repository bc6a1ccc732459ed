"""The board NUCLEO-G474RE: its image, its pins, and the check of its registers' header."""
