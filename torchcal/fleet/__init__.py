"""Many jobs: where they run, what becomes of each, and the table and the page of all of them."""
