"""What a record is fit for, and how far a model and a record are apart."""
