"""python -m salient.finite_elements OUT.csv"""

import sys

from salient.errors import exit_code
from salient.finite_elements.map import main

sys.exit(exit_code(lambda: main(sys.argv[1:])))
