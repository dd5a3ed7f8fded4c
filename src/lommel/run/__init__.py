"""From files to files: stages, products, records."""
