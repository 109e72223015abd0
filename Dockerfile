# cgid monitor under a supervisor: docs/how-to/plant.md. Build: docker build -t cgid .
FROM python:3.12-slim AS wheel
COPY . /source
RUN pip wheel --no-cache-dir --no-deps -w /wheels /source

FROM python:3.12-slim
RUN --mount=from=wheel,source=/wheels,target=/wheels \
    pip install --no-cache-dir "$(echo /wheels/cgid-*.whl)[plant,formats]" && useradd --create-home cgid
COPY docker/supervise /usr/local/bin/
USER cgid
WORKDIR /home/cgid
# An image that cannot answer is not built.
RUN cgid predict --sample > /dev/null
EXPOSE 1502 8000
ENTRYPOINT ["supervise", "cgid"]
CMD ["monitor", "--help"]
