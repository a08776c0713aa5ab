"""The data sets that `stmc prepare` supports, one package each, and the formats that several share."""
