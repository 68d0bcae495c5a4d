code=0
datagen farm status "$folder" || code=$?
datagen run "$folder" --only index --deep || code=$?
datagen verify "$folder" --workers @{collect_cpus} || code=$?
datagen report "$folder" --workers @{collect_cpus} || code=$?
exit "$code"
