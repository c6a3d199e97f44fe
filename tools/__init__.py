"""What a person types or looks at: the command line, benchmarks, pictures, generated documents."""
