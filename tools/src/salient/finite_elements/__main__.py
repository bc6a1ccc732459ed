"""python -m salient.finite_elements OUT.csv"""

import sys

from salient.finite_elements.map import main

sys.exit(main(sys.argv[1:]))
