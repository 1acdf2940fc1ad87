"""What a person looks at: the hybrid view, the figures and the report."""
