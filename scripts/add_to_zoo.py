"""Put a trained policy into the zoo, with its evaluation and its model card."""

import sys

from agents.zoo.command import main

if __name__ == "__main__":
    sys.exit(main())
