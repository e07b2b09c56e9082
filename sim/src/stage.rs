//! The stage: a database of its own, coordinators, tokens, jobs and crews; at the end, the books are compared.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use engine::{Error, ErrorKind, Result};
use protocol::admin::{Secret, TokenRequest};
use protocol::job::{JobDetail, JobRequest};
use protocol::{BatchState, PassKind, PassState, Role};
use serde_json::json;
use server::db::Store;
use tempfile::TempDir;
use worker::client::Client;

use crate::crew::{Crew, Way};
use crate::fake::{SET, Shared, Temper};
use crate::load::Load;
use crate::process::{Launch, Process, Setup, free_port};

/// Patience of those who submit and look.
const PATIENCE: Duration = Duration::from_secs(30);
/// Batches that are read at once when the books are compared.
const PAGE: i64 = 10_000;

/// How a stage is set.
#[derive(Clone, Debug)]
pub struct Options {
    /// How coordinators are started.
    pub launch: Launch,
    /// A PostgreSQL server on which the stage makes a database of its own; a SQLite file otherwise.
    pub postgres: Option<String>,
    /// Repeats the workers' choices.
    pub seed: u64,
    /// Coordinators; one with SQLite.
    pub coordinators: usize,
    /// Seconds that leases last.
    pub lease_s: u32,
}

/// A stage.
pub struct Stage {
    folder: TempDir,
    options: Options,
    database: String,
    setups: Vec<Setup>,
    /// The coordinators; none where one was killed.
    pub processes: Vec<Option<Process>>,
    urls: Vec<String>,
    token: String,
    /// Somebody who may do everything but a worker's work, by way of each coordinator.
    pub people: Vec<Client>,
    /// What the workers share.
    pub shared: Arc<Shared>,
    crews: Vec<Crew>,
    hired: usize,
}

/// A job on the stage.
#[derive(Clone, Debug)]
pub struct Job {
    /// Its id.
    pub id: String,
    /// Its load's number.
    pub load: u64,
}

impl Stage {
    /// Sets the stage.
    ///
    /// # Errors
    /// When the database cannot be made, or a coordinator does not start.
    pub fn set(options: &Options) -> Result<Self> {
        let folder = tempfile::tempdir();
        let folder =
            folder.map_err(|error| Error::new(ErrorKind::Io, "no folder can be had").caused_by(error))?;
        let database = match &options.postgres {
            Some(server) => make_database(server)?,
            None => format!("sqlite:{}", folder.path().join("queue.db").display()),
        };
        let setup = |number| Setup {
            data: folder.path().join(format!("coordinator-{number}")),
            storage: folder.path().join("storage"),
            database: database.clone(),
            lease_s: options.lease_s,
            environment: Vec::new(),
        };
        let count = if options.postgres.is_some() { options.coordinators.max(1) } else { 1 };
        let setups: Vec<Setup> = (0..count).map(setup).collect();
        let mut processes = Vec::new();
        for setup in &setups {
            processes.push(Some(Process::start(&options.launch, setup, free_port()?)?));
        }
        let urls: Vec<String> = processes.iter().flatten().map(Process::url).collect();
        let admin = secret(&setups[0].data.join("admin.token"))?;
        let people =
            urls.iter().map(|url| Client::new(url, Some(&admin), PATIENCE)).collect::<Result<Vec<_>>>()?;
        let token = worker_token(&people[0], "fakes")?.secret;
        let (shared, crews, hired) = Default::default();
        let options = options.clone();
        Ok(Self { folder, options, database, setups, processes, urls, token, people, shared, crews, hired })
    }

    /// A client of a coordinator that runs.
    pub fn client(&self) -> &Client {
        let running = self.processes.iter().position(Option::is_some).unwrap_or(0);
        &self.people[running]
    }

    /// Submits a job.
    ///
    /// # Errors
    /// When a coordinator refuses it.
    pub fn submit(&self, load: Load, change: impl FnOnce(&mut JobRequest)) -> Result<Job> {
        submit(&self.shared, self.client(), load, change)
    }

    /// A worker's token of its own.
    ///
    /// # Errors
    /// When the coordinator refuses.
    pub fn worker_token(&self, label: &str) -> Result<Secret> {
        worker_token(self.client(), label)
    }

    /// Hires workers; the number of the first.
    ///
    /// # Errors
    /// When no threads can be had.
    pub fn hire(&mut self, tempers: &[Temper]) -> Result<usize> {
        let token = self.token.clone();
        self.hire_with(&token, tempers)
    }

    /// Hires workers with another token; the number of the first.
    ///
    /// # Errors
    /// When no threads can be had.
    pub fn hire_with(&mut self, token: &str, tempers: &[Temper]) -> Result<usize> {
        let first = self.hired;
        let crew = self.start_crew(token, tempers)?;
        self.crews.push(crew);
        Ok(first)
    }

    fn start_crew(&mut self, token: &str, tempers: &[Temper]) -> Result<Crew> {
        let way = Way { urls: &self.urls, token, seed: self.options.seed };
        let crew = Crew::start(&self.shared, &way, self.hired, tempers)?;
        self.hired += tempers.len();
        Ok(crew)
    }

    /// Brings jobs up to their bakes, and no further.
    ///
    /// # Errors
    /// When that takes too long.
    pub fn prepare(&mut self, jobs: &[&Job]) -> Result<()> {
        let shy = Temper { is_shy: true, wait: Duration::from_millis(200), ..Temper::default() };
        let token = self.token.clone();
        let crew = self.start_crew(&token, &[shy; 2])?;
        let mut left: Vec<&Job> = jobs.to_vec();
        let ready = self.until("the bakes are open", PATIENCE, || {
            let mut waiting = Vec::new();
            for &job in &left {
                let detail = self.client().job(&job.id)?;
                let open = |pass: &protocol::job::PassDetail| {
                    pass.kind == PassKind::Bake && pass.state == PassState::Open
                };
                // Who is there waits, so that the others' turn comes soon
                match detail.passes.iter().any(open) {
                    true => drop(self.client().act(&job.id, "pause")?),
                    false => waiting.push(job),
                }
            }
            left = waiting;
            Ok(left.is_empty())
        });
        crew.join()?;
        ready?;
        jobs.iter().try_for_each(|job| Ok(self.client().act(&job.id, "resume").map(drop)?))
    }

    /// Waits until all who are hired are known to a coordinator.
    ///
    /// # Errors
    /// When it takes longer than `patience`.
    pub fn until_known(&self, patience: Duration) -> Result<()> {
        let hired: usize = self.crews.iter().map(Crew::len).sum();
        self.until("all workers are known", patience, || {
            Ok(self.shared.registered.load(Ordering::Relaxed) >= hired)
        })
    }

    /// Waits until something is so.
    ///
    /// # Errors
    /// When it is not so in time.
    pub fn until(
        &self,
        what: &str,
        patience: Duration,
        mut is_so: impl FnMut() -> Result<bool>,
    ) -> Result<()> {
        let start = Instant::now();
        while !is_so()? {
            if start.elapsed() > patience {
                return Err(Error::new(ErrorKind::Io, format!("after {patience:?}, it is not so: {what}")));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(())
    }

    /// Waits for a job's end.
    ///
    /// # Errors
    /// When it does not come in time.
    pub fn finish(&self, job: &Job, patience: Duration) -> Result<JobDetail> {
        self.until("the job has ended", patience, || {
            Ok(self.client().job(&job.id)?.summary.state.is_final())
        })?;
        Ok(self.client().job(&job.id)?)
    }

    /// The coordinators' counters and gauges, summed; names with their labels.
    pub fn metrics(&self) -> HashMap<String, f64> {
        let mut sums = HashMap::new();
        for (client, _) in self.people.iter().zip(&self.processes).filter(|(_, process)| process.is_some()) {
            let text = client.text("/metrics").unwrap_or_default();
            for line in text.lines().filter(|line| !line.starts_with('#')) {
                if let Some((name, value)) = line.rsplit_once(' ')
                    && let Ok(value) = value.parse::<f64>()
                {
                    *sums.entry(name.to_owned()).or_default() += value;
                }
            }
        }
        sums
    }

    /// Kills a coordinator.
    pub fn kill(&mut self, number: usize) {
        if let Some(process) = &mut self.processes[number] {
            process.kill();
        }
        self.processes[number] = None;
    }

    /// Starts a coordinator again at its address, with these variables in its environment.
    ///
    /// # Errors
    /// When it does not start.
    pub fn restart(&mut self, number: usize, environment: &[(&str, String)]) -> Result<()> {
        let listen = self.urls[number].trim_start_matches("http://").parse();
        let listen = listen.map_err(|_| Error::invalid("an address that is none"))?;
        let own = environment.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect();
        let setup = Setup { environment: own, ..self.setups[number].clone() };
        self.processes[number] = Some(Process::start(&self.options.launch, &setup, listen)?);
        Ok(())
    }

    /// What repeats the workers' choices.
    pub fn seed(&self) -> u64 {
        self.options.seed
    }

    /// The database's URL.
    pub fn database(&self) -> &str {
        &self.database
    }

    /// Ends everything and compares the books; what contradicts itself.
    ///
    /// # Errors
    /// When the database cannot be read.
    pub fn end(mut self) -> Result<Vec<String>> {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.crews.iter().for_each(Crew::dismiss);
        // Nobody waits for an answer that has nobody to give it
        (0..self.processes.len()).for_each(|number| self.kill(number));
        for crew in std::mem::take(&mut self.crews) {
            crew.join()?;
        }
        let mut problems = std::mem::take(&mut self.shared.ledger.seen().problems);
        problems.extend(block_on(audit(&self.database, self.shared.ledger.counted()))?);
        if let Some(server) = &self.options.postgres {
            drop_database(server, &self.database)?;
        }
        // The folder goes with this
        drop(self.folder);
        Ok(problems)
    }
}

/// Submits a job by way of `client`; a repetition would make no second one.
///
/// # Errors
/// When the coordinator refuses it.
pub fn submit(
    shared: &Shared,
    client: &Client,
    load: Load,
    change: impl FnOnce(&mut JobRequest),
) -> Result<Job> {
    let number = shared.loads.add(load);
    let mut request = request(number)?;
    change(&mut request);
    let submitted = client.submit(&request, &format!("load-{number}"))?;
    let id = submitted.jobs.into_iter().next();
    let id = id.ok_or_else(|| Error::new(ErrorKind::Io, "a submission made no job"))?;
    Ok(Job { id, load: number })
}

fn worker_token(client: &Client, label: &str) -> Result<Secret> {
    let (project, expires_s) = (None, None);
    let request = TokenRequest { role: Role::Worker, project, label: label.into(), expires_s };
    Ok(client.create_token(&request)?)
}

/// Compares what the database counts with what it has, and both with what the workers were told.
async fn audit(database: &str, counted: HashMap<(i64, i64), i64>) -> server::Result<Vec<String>> {
    let store = Store::open(database, 2).await?;
    let mut problems: Vec<String> =
        store.drift().await?.iter().map(|drift| format!("counts differ: {drift:?}")).collect();
    let orphans = store.orphans().await?;
    if orphans > 0 {
        problems.push(format!("{orphans} batches and leases do not agree"));
    }
    let mut told: HashMap<i64, HashMap<i64, i64>> = HashMap::new();
    for ((pass, batch), fence) in counted {
        told.entry(pass).or_default().insert(batch, fence);
    }
    for (pass, told) in told {
        let Some(job) = store.job_of(pass).await? else {
            problems.push(format!("pass {pass} is not there"));
            continue;
        };
        let (mut after, mut same) = (Some(-1), 0);
        while let Some(from) = after {
            let page = store.batches(&job, pass, None, from, PAGE).await?;
            for batch in &page.batches {
                let is_told = told.get(&batch.batch);
                let agrees = batch.state == BatchState::Done && is_told == Some(&batch.fence);
                if is_told.is_some() && !agrees {
                    problems.push(format!("a worker was told {is_told:?} of pass {pass}, {batch:?}"));
                }
                same += usize::from(is_told.is_some());
            }
            after = page.next;
        }
        if same != told.len() {
            problems.push(format!("{} batches of pass {pass} are not there", told.len() - same));
        }
    }
    store.driver().close().await;
    problems.truncate(20);
    Ok(problems)
}

fn request(load: u64) -> Result<JobRequest> {
    let scene = format!(
        r#"<scene version="1" units="m" up="y">
  <shaders> <shader name="occlusion" type="sh_occlusion"/> </shaders>
  <geometries>
    <geometry name="{SET}" occluder="true">
      <stream procedural="terrain" seed="7" micropolygons="20000"/>
      <bakeset name="{SET}"> <attribute name="sh" shader="occlusion"/> </bakeset>
    </geometry>
  </geometries>
</scene>"#
    );
    let request = json!({ "name": format!("load {load}"), "scene": scene, "settings": { "seed": load } });
    serde_json::from_value(request).map_err(|error| Error::invalid(error.to_string()))
}

/// The secret in a file, which a coordinator writes after it has begun to listen.
fn secret(path: &Path) -> Result<String> {
    let start = Instant::now();
    while !path.exists() && start.elapsed() < PATIENCE {
        std::thread::sleep(Duration::from_millis(10));
    }
    let text = std::fs::read_to_string(path).map_err(|error| Error::io("read", path, error))?;
    Ok(text.trim().to_owned())
}

/// A new database on the server of `url`.
fn make_database(url: &str) -> Result<String> {
    let (server, _) = url.rsplit_once('/').ok_or_else(|| Error::invalid("this is no database's URL"))?;
    let name = format!("pantaray_sim_{:x}", server::random::bits());
    let statement = format!("CREATE DATABASE {name}");
    run_on(url, statement)?;
    Ok(format!("{server}/{name}"))
}

fn drop_database(server: &str, url: &str) -> Result<()> {
    let name = url.rsplit('/').next().unwrap_or_default();
    run_on(server, format!("DROP DATABASE {name} WITH (FORCE)"))
}

fn run_on(url: &str, statement: String) -> Result<()> {
    block_on(async {
        let store = Store::open(url, 1).await?;
        store.driver().query(statement.into(), Vec::new()).await?;
        store.driver().close().await;
        Ok(())
    })
}

/// Waits for something of the database.
fn block_on<T>(work: impl Future<Output = server::Result<T>>) -> Result<T> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime =
        runtime.map_err(|error| Error::new(ErrorKind::Io, "no runtime can be had").caused_by(error))?;
    runtime.block_on(work).map_err(|error| Error::new(ErrorKind::Io, error.detail))
}
