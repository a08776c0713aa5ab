"""HumanML3D as it is published: folders of features and texts."""
