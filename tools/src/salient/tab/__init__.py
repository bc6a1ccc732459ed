"""The drive in a browser tab: the page and everything that it needs in one file, and links that reproduce a run."""
