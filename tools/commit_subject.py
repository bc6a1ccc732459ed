#!/usr/bin/env python3
"""Hook of commit-msg: the subject of a commit has at most 72 characters.

    commit_subject.py FILE
"""

import sys
from pathlib import Path

SUBJECT_MAX = 72


def refusal(message: str) -> str:
    """One line when the subject is too long, else empty; subjects that git writes itself pass."""
    lines = [line for line in message.splitlines() if not line.startswith("#")]
    subject = next((line.strip() for line in lines if line.strip()), "")
    if len(subject) <= SUBJECT_MAX or subject.startswith(("Merge ", "Revert ", "fixup! ", "squash! ")):
        return ""
    return f"subject has {len(subject)} characters, at most {SUBJECT_MAX}: {subject}"


if __name__ == "__main__":
    sys.exit(refusal(Path(sys.argv[1]).read_text(encoding="utf-8")) or 0)
