"""The data sets that `stmc prepare` knows: one file a source, and the formats that several share."""
