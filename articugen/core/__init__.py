"""What every room speaks: errors, arithmetic, records, the schema, recipes, files, processes."""
