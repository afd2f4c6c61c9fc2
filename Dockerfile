# The same studio without Python on the host: docker compose up --build
# Two images: `web` knows nothing of learning and simulation; the last one, for everything else, has all of it.
FROM python:3.11-slim AS web
WORKDIR /studio
COPY requirements-web.lock ./
RUN pip install --no-cache-dir --no-deps --require-hashes -r requirements-web.lock
COPY pyproject.toml README.md alembic.ini ./
COPY app app
# descriptions of tasks; nothing in here is imported
COPY worker worker
COPY migrations migrations
COPY templates templates
COPY static static
COPY docs/arrays.md docs/arrays.md
RUN pip install --no-cache-dir --no-deps -e . \
    && useradd --create-home studio && mkdir /data /keys && chown studio /data /keys
USER studio
ENV DATA_DIR=/data HOST=0.0.0.0
VOLUME /data
EXPOSE 8000
CMD ["python", "-m", "app", "web"]

FROM python:3.11-slim
RUN apt-get update && apt-get install -y --no-install-recommends make && rm -rf /var/lib/apt/lists/*
WORKDIR /studio
COPY Makefile pyproject.toml requirements.lock README.md alembic.ini ./
COPY install install
COPY app app
COPY worker worker
COPY migrations migrations
COPY templates templates
COPY static static
COPY docs/arrays.md docs/arrays.md
RUN make .venv/run.stamp && useradd --create-home studio && mkdir /data /keys && chown studio /data /keys
USER studio
ENV DATA_DIR=/data HOST=0.0.0.0 PUBLIC_URL=http://localhost:8000
VOLUME /data
EXPOSE 8000
CMD [".venv/bin/python", "-m", "app", "up"]
