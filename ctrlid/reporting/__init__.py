"""What people look at: tables, pictures, pages, the command line."""
