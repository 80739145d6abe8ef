"""Models from records: what a fit returns, and the estimators."""
