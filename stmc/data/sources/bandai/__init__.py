"""The Bandai Namco Research motion dataset: its recordings, and clips of them."""
