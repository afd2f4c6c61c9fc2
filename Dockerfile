# The same studio without Python on the host: docker compose up --build
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
RUN make .venv/run.stamp && useradd --create-home studio && mkdir /data && chown studio /data
USER studio
ENV DATA_DIR=/data HOST=0.0.0.0 PUBLIC_URL=http://localhost:8000
VOLUME /data
EXPOSE 8000
CMD [".venv/bin/python", "-m", "app", "up"]
