"""CMU's motion capture database: its formats and recordings, and clips of them."""
