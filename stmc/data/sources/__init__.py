"""The data sets that scripts/prepare.py knows: one file a source, and the formats that several share."""
