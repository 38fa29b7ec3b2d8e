"""Images of many instruments, analysed by many workers into one data set."""
