"""The live page of a drive: a server on the loopback, and the page in page/."""
