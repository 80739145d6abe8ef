"""What every room uses: refusals, words and numbers for people, jobs."""
